"""The map as a stage of the pipeline: keyframes and poses in, what has to be stored of them out."""

from collections.abc import Mapping
from pathlib import Path

from vislam.config import MapConfig
from vislam.core.camera import Rig
from vislam.core.clock import StageClock
from vislam.core.memory import PackedScan
from vislam.core.messages import Array, GraphUpdate
from vislam.mapping.depth.mono import MonoDepth, SeenFrame
from vislam.mapping.mapper import Mapper
from vislam.mapping.semantic.images import LabelFolder, Labeller, camera_t_ns
from vislam.trajectory.odometry_keyframe import OdometryKeyframe


class MapStage:
    """Owns the mapper, and the filter of depth where that comes from one moving camera.

    Attributes:
        held: what was restored is a map that is not to change: new keyframes are left out.
    """

    def __init__(
        self, config: MapConfig, rig: Rig, one_camera: bool, clock: StageClock, labeller: Labeller | None = None
    ) -> None:
        """Prepare for a rig; with `one_camera` depth comes from frames between keyframes.

        `labeller` gives the labels of keyframes; None: the folder of label images in the settings, if there is one.
        Raises DataError when settings and rig cannot make a map, or the label images cannot be used.
        """
        if labeller is None and config.labels.folder is not None:
            labeller = LabelFolder(Path(config.labels.folder), rig.cameras[0])
        self._labeller = labeller
        self._keyframes_labelled = 0
        self.mapper = Mapper(config, rig, one_camera, None if labeller is None else labeller.classes)
        self.held = False
        self._depth = MonoDepth(config.mono_depth, rig) if one_camera else None
        self._clock = clock

    @property
    def wants_frames(self) -> bool:
        """Whether `add` has use for the frames between two keyframes."""
        return self._depth is not None and not self.held

    @property
    def counters(self) -> dict[str, dict[str, int]]:
        """Counters of the rooms that there are."""
        depth = {} if self._depth is None else {"mono depth": dict(self._depth.counters)}
        return {"map": {**self.mapper.counters, **self._label_counters()}, **depth}

    def restore(self, scans: Mapping[int, PackedScan], T_map_body: Array, held: bool) -> None:
        """Take over the scans of an earlier run, by keyframe, at the poses [M, 4, 4] of keyframes 0..M-1."""
        self.mapper.restore(dict(scans), dict(enumerate(T_map_body)))
        self.held = held

    def move(self, update: GraphUpdate) -> None:
        """Follow corrected poses."""
        with self._clock.measure("map move"):
            self.mapper.move(update)
        if self._depth is not None:
            self._depth.move(update.ids, update.T_map_body)

    def add(self, odometry: OdometryKeyframe, T_map_body: Array, seen: list[SeenFrame]) -> dict[int, PackedScan]:
        """Take a keyframe at its pose [4, 4], and the frames before it; return the scans that came with it.

        They are its own, and that of an earlier keyframe whose depth is done now.
        """
        if self.held:
            return {}
        keyframe = odometry.packet.keyframe
        labels = None
        if self._labeller is not None:
            with self._clock.measure("labels"):
                labels = self._labeller(keyframe.frame, camera_t_ns(keyframe.t_ns, odometry.packet.time_offset_s))
            self._keyframes_labelled += labels is not None
        with self._clock.measure("map"):
            self.mapper.add(keyframe, T_map_body, labels)
        changed = [keyframe.id]
        if self._depth is not None:
            with self._clock.measure("depth"):
                late = self._depth.add(odometry, T_map_body, seen)
            if late is not None:
                changed.append(late.keyframe_id)
                with self._clock.measure("map"):
                    self.mapper.add_depth(late)
        packed = {i: self.mapper.packed(i) for i in changed}
        return {i: scan for i, scan in packed.items() if scan is not None}

    def _label_counters(self) -> dict[str, int]:
        """Return what came of label images; nothing where none were to come."""
        if self._labeller is None:
            return {}
        problems = self._labeller.problems if isinstance(self._labeller, LabelFolder) else {}
        return {"keyframes_labelled": self._keyframes_labelled, **problems}

    def finish(self) -> None:
        """Bring the map to exactly the newest poses."""
        with self._clock.measure("map finish"):
            self.mapper.finish()
