"""The tight filter: tracks of corners correct the inertial state directly, by the poses they were seen from.

A multi-state constraint Kalman filter: past poses are cloned into the state, a track that ends is triangulated over
them and its point projected out, so that its pixels constrain the poses alone (Mourikis and Roumeliotis, ICRA 2007).
Long tracks stay as points in the state (Li and Mourikis, RSS 2012; Geneva et al., "OpenVINS", ICRA 2020). Errors are
right-invariant, which keeps the unobservable directions unobservable (`kernels`). The time offset of the camera
and its rotation in the body are estimated with the rest (Li and Mourikis, "Online temporal calibration", IJRR 2014).
As in `Ekf`, measurements may come late and in any order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vislam.config import EkfConfig, MachineConfig
from vislam.core.blas import on_one_blas_thread
from vislam.core.geometry import so3_log
from vislam.core.messages import Array, NavState, Observations, VoMeasurement
from vislam.ekf.history import AtRest, Event
from vislam.ekf.sensed_timeline import SensedTimeline
from vislam.ekf.tight.core import CameraCalibration, TightCore, TightState
from vislam.ekf.tight.state import MOUNT, TIME
from vislam.ekf.tight.tracks import FrameTracks, prepare
from vislam.ekf.timeline import UpdateResult
from vislam.imu import ImuNoise
from vislam.sensors import Suite

if TYPE_CHECKING:  # the fast path must not load OpenCV
    from vislam.core.camera import Rig
    from vislam.ekf.correction import Correction, Hint


class MsckfEkf(SensedTimeline[TightState, FrameTracks]):
    """The timeline with the tight core. Times of states are by the IMU's clock, those of frames by the camera's."""

    def __init__(
        self, config: EkfConfig, noise: ImuNoise, machine: MachineConfig, rig: Rig, suite: Suite | None = None
    ) -> None:
        """Set up an uninitialised filter.

        Args:
            config: see `EkfConfig`.
            noise: of the IMU, until `follow_noise` gives what the samples show.
            machine: gravity is down in `odom`.
            rig: cameras; observations may also hold right pixels (a pair), depth, and tracks of further cameras.
            suite: sensors other than IMU and camera; None: there are none.
        """
        self._rig = rig
        self._readout_s = config.tight_readout_s or 0.0
        self._tight = TightCore(config, noise, float(machine.gravity_m_s2), rig, suite)
        super().__init__(self._tight, self._tight.blank(), config.tight_history_s, machine)

    @property
    def calibration(self) -> CameraCalibration:
        """The camera's time offset and rotation as estimated so far."""
        window = self._state.window
        sigmas = np.sqrt(np.maximum(np.diag(window.P), 0.0))
        turned = so3_log(np.ascontiguousarray(self._tight.R_configured.T @ window.R_body_cam))
        return CameraCalibration(window.time_offset_s, float(sigmas[TIME]), turned, sigmas[MOUNT].copy())

    def initialise(
        self, state: NavState, vo: VoMeasurement | None = None, camera: CameraCalibration | None = None
    ) -> None:
        """Set the state, at any time, and run it through the samples that are already here. Forgets the past.

        Args:
            state: pose in `odom`, with its covariance.
            vo: not needed here; tracks begin with the frames that follow.
            camera: what an earlier run found out about the camera; None: what is configured.

        Raises:
            ValueError: the state is not finite.
        """
        self._begin(state.t_ns, self._tight.begin(state, camera, self._state.window.noise))

    def resume(self, state: NavState, vo: VoMeasurement, camera: Array | None) -> None:
        """Start where an earlier run was, with what its filter had learned of the camera, see `camera`."""
        if camera is None:
            self.initialise(state, vo)
            return
        found = CameraCalibration(float(camera[0]), float(camera[1]), camera[2:5].copy(), camera[5:8].copy())
        self.initialise(state, None, found)

    @property
    def camera(self) -> Array | None:
        """What was learned of the camera [8]: time offset, its sigma, rotation, its sigmas (s, rad)."""
        found = self.calibration
        return np.array([
            found.time_offset_s, found.time_offset_sigma_s, *found.rotation_rad, *found.rotation_sigma_rad
        ])  # fmt: skip

    def add_keyframe(self, keyframe_id: int, t_ns: int) -> UpdateResult:
        """Count a keyframe; every frame is cloned anyway."""
        self._counts["keyframes"] += 1
        return UpdateResult(True, float("nan"), "")

    @on_one_blas_thread
    def update_vision(self, vo: VoMeasurement, observations: Observations, shows_scale: bool = True) -> UpdateResult:
        """Take the tracks of a frame; its motion only has its time and whether vision is lost.

        `nis` of the result is that of all rows used, after compression. A frame may use nothing, since tracks are used
        when they end or have been followed through the whole window. No new point is kept in the state while the motion
        does not show scale.
        """
        if not vo.tracking.sees and not observations.further:
            return self._refuse("vision_lost", "tracking lost")
        if self._history is not None and self._history.holds(vo.t_ns, FrameTracks):
            return self._refuse("vision_duplicate", f"a frame of {vo.t_ns} ns is here already")
        readout_s = observations.readout_s
        readout_s = self._readout_s if readout_s is None or self._readout_s != 0.0 else readout_s
        frame = prepare(vo.t_ns, observations, self._rig, readout_s, shows_scale)
        if not len(frame.ids):
            return self._refuse("vision_invalid", "no track with finite pixels inside the camera model")
        return self._insert(Event(vo.t_ns, frame))

    def correct(self, seen: Correction) -> UpdateResult:
        """Take all of a frame; return the answer to its tracks."""
        answer = self.update_vision(seen.vo, seen.observations, seen.shows_scale)
        if seen.at_rest:
            self.update_zero_velocity(seen.t_ns)
        if seen.keyframe_id is not None:
            self.add_keyframe(seen.keyframe_id, seen.t_ns)
        return answer

    def hold(self, hint: Hint) -> None:
        """Leave out what holds the body while the camera sees nothing: rest is an event of frames here."""

    def update_zero_velocity(self, t_ns: int) -> UpdateResult:
        """Assume that the body is at rest at a frame: no velocity, and the pose where rest began."""
        return self._insert(Event(t_ns, AtRest()))
