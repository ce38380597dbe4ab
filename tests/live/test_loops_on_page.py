"""The loops of the live page are those of the run's own table, keyframe by keyframe, as the graph revises them."""

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from vislam.config import GraphConfig, WindowConfig
from vislam.graph import PoseGraph
from vislam.live.web.map_share import LoopShare
from vislam.loop import as_candidate
from vislam.runs.folder import RunLog
from worlds.lap import RIG, World
from worlds.parts import MACHINE

CONFIG = GraphConfig(coupling="loose", vo_inflation=1.0, vo_floor_deg=0.0, vo_floor_m=0.0)


class Shown:
    """A graph whose loops come to a run's table and to the page."""

    def __init__(self, world: World) -> None:
        self.graph = PoseGraph(CONFIG, None, MACHINE, RIG, WindowConfig())
        self.graph.initialise(None, world.truth[0])
        self.world, self.log, self.share = world, RunLog(), LoopShare()
        self.on_page: dict[tuple[int, int, str], str] = {}
        self.history: dict[tuple[int, int, str], list[str]] = {}

    def add(self, k: int, edges, refused=()) -> None:
        """Add a keyframe with edges that the verifier lets through, and pairs that it does not."""
        packet = self.world.packet(k, imu=False)
        found = [replace(as_candidate(self.world.loop(0, a, b)), decision="pending") for a, b in refused]
        candidates = [replace(c, source="odometry") for c in (*found, *map(as_candidate, edges))]
        update = self.graph.add(packet, edges)
        record = self.graph.take_record()
        self.log.add_keyframe(SimpleNamespace(
            odometry=SimpleNamespace(packet=packet, T_odom_body=self.world.truth[k]), candidates=candidates,
            retrieved=[], edges=edges, update=update, record=record,
        ))  # fmt: skip
        self.share.found(candidates, edges)
        self.agree(record)

    def agree(self, record) -> None:
        """Ask that the page has what the table would have now."""
        self.share.decided(record.loops)
        for loop in self.share.take_changed():
            key = loop.from_id, loop.to_id, loop.source
            self.on_page[key] = loop.decision
            self.history.setdefault(key, []).append(loop.decision)
        rows = self.log.loop_rows({report.loop_id: report for report in self.graph.edge_reports()})
        assert self.share.counts == Counter(row.decision for row in rows)
        assert self.on_page == {(row.from_id, row.to_id, row.source): row.decision for row in rows}  # the last word


def test_counts_and_states_are_those_of_the_table_and_are_revised_with_it() -> None:
    shown = Shown(World(60.0, seed=5, vo_sigma_rad=np.deg2rad(0.15), vo_sigma_m=0.004))
    right = shown.world.loop(1, 4, 103)
    T = right.T_from_to.copy()
    T[:3, 3] += np.array([0.10, -0.08, 0.06])  # wrong, but inside a gate that drift made wide
    for k in range(shown.world.count):
        edges = [shown.world.loop(k, k - 100, k)] if k > 103 and k % 3 == 0 else []
        edges += [replace(right, T_from_to=T)] if k == 103 else []
        shown.add(k, edges, [(4, 103), (9, 103)] if k == 103 else [])  # one pair waits first, as of a second view
    shown.graph.finish()
    shown.agree(shown.graph.take_record())
    assert shown.history[4, 103, "odometry"] == ["accepted", "rejected"]
    assert shown.on_page[9, 103, "odometry"] == "pending"
    assert shown.share.counts["accepted"] > 10
