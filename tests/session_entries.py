"""What a session is given with a keyframe, for tests that make one by hand."""

from __future__ import annotations

from vislam.imu import ImuNoise
from vislam.memory import LoopPlace, LoopState, StartFacts
from vislam.messages import LoopDecision, NavState


def decided(loop_id: int, accepted: bool) -> LoopState:
    """Return a loop that was accepted, or rejected."""
    decision = LoopDecision.ACCEPTED if accepted else LoopDecision.REJECTED
    return LoopState(loop_id, decision, "", 1.5, LoopPlace.GRAPH if accepted else LoopPlace.OUT, None)


def start_facts(state: NavState, noise: ImuNoise) -> StartFacts:
    """Return a start at rest with a first state."""
    return StartFacts("static", "at rest", state, 0.0, 0.0, noise, state)
