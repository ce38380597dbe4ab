"""What a run is worth, judged without any truth: evidence in, a verdict with its reasons out."""

from vislam.runs.verdict.agreement import ForceAgreement, TurnAgreement, TurnStep, force_agreement, turn_agreement
from vislam.runs.verdict.evidence import Apart, Driven, Evidence, Innovations, Moved
from vislam.runs.verdict.judging import LOST_S, Trust, Verdict, judge, verdict_sentence

__all__ = [
    "LOST_S",
    "Apart",
    "Driven",
    "Evidence",
    "ForceAgreement",
    "Innovations",
    "Moved",
    "Trust",
    "TurnAgreement",
    "TurnStep",
    "Verdict",
    "force_agreement",
    "judge",
    "turn_agreement",
    "verdict_sentence",
]
