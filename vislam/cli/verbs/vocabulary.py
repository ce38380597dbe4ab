"""`vislam vocabulary`: the words of loop closing, trained or converted."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from vislam.cli.verbs.arguments import parse
from vislam.config.ranges import Count, Few, Many, Range, Seed
from vislam.core.errors import UsageError


@dataclass(frozen=True)
class VocabularyOptions:
    """Options of `vislam vocabulary`."""

    out: Path
    """File to write, for --loop.vocabulary"""
    sources: Positional[tuple[str, ...]] = ()
    """Folders of PNG or JPEG images, and recordings as for `run`"""
    from_orbslam: Path | None = None
    """Convert this text vocabulary of ORB-SLAM instead of training one"""
    every: Count = 1
    """Use every n-th image"""
    features: Count = 1000
    """ORB descriptors per image"""
    branching: Annotated[int, Range(2, 100)] = 10
    """Children of a node"""
    depth: Few | None = None
    """Levels; None: as many as leave each word some descriptors"""
    max_descriptors: Many = 1_000_000
    """That the tree grows on, taken evenly"""
    seed: Seed = 0
    """Same seed, same bytes"""


OPTIONS = (VocabularyOptions,)


def main(arguments: list[str]) -> int:
    """Train a vocabulary on images, or convert ORB-SLAM's."""
    options = parse(VocabularyOptions, arguments, "vocabulary")
    from vislam.loop import read_orbslam
    from vislam.runs.offline.train_vocabulary import train_vocabulary

    if (options.from_orbslam is None) != bool(options.sources):
        raise UsageError("give either SOURCE... to train on, or --from-orbslam FILE to convert")
    if options.from_orbslam is not None:
        vocabulary, origin = read_orbslam(options.from_orbslam), str(options.from_orbslam)
    else:
        left_out = ("sources", "out", "from_orbslam")
        choices = {name: value for name, value in asdict(options).items() if name not in left_out}
        vocabulary, images, unreadable = train_vocabulary(options.sources, **choices)
        origin = f"{images} images" + (f" ({unreadable} could not be read)" if unreadable else "")
    vocabulary.save(options.out)
    print(f"{vocabulary.word_count} words from {origin}; next: vislam run ... --loop.vocabulary {options.out}")
    return 0
