"""The virtual cart's camera: a process renders what it sees, in real time, and the front process takes the newest."""

import struct
import time

import cv2
import numpy as np

from vislam.core.messages import Frame, ImageF32, ImageU8
from vislam.hw.health import Health
from vislam.live.epoch import Epoch
from vislam.live.processes.child import Life
from vislam.live.virtual.motion import Follower, Segment
from vislam.live.virtual.place import BODY_HEIGHT_M, PlaceOptions, make_scene, virtual_rig
from vislam.live.wire.slot import SlotReader, SlotWriter, wait_for
from vislam.sim.scene import Renderer
from vislam.sim.sensing import DepthNoise, Imager, sense_depth

_NS = 1_000_000_000
_HEAD = struct.Struct("<qqii")  # stamp, index, height, width
_MISSING_NS = 500_000_000
_POLL_S = 0.001


class Eye:
    """What the cart's camera sees from where it is."""

    def __init__(self, options: PlaceOptions) -> None:
        """Paint its world; takes seconds."""
        self.rig = virtual_rig(options)
        camera = self.rig.cameras[0]
        self._scene, self._renderer = make_scene(options.world, options.seed), Renderer(camera)
        self._imager = Imager(camera.width, camera.height, noisy=True)
        self._rng = np.random.default_rng(np.random.SeedSequence(options.seed, spawn_key=(5,)))

    def see(self, here: Segment) -> tuple[ImageU8, ImageF32 | None]:
        """Return the grey image [H, W] and, of a camera with depth, that [H, W]; the next call has other noise."""
        light, exact = self._renderer.render(self._scene, here.T_world_body(BODY_HEIGHT_M) @ self.rig.T_body_cams[0])
        grey = cv2.cvtColor(self._imager.sense(light, 1.0, self._rng), cv2.COLOR_BGR2GRAY).astype(np.uint8)
        return grey, sense_depth(exact, DepthNoise(), self._rng) if self.rig.has_depth else None


def run_camera(life: Life, name: str, cart: str, epoch: Epoch, options: PlaceOptions) -> None:
    """Render frames until the run ends; one that cannot be rendered in time is left out."""
    eye = Eye(options)
    camera = eye.rig.cameras[0]
    slot = SlotWriter(name, _HEAD.size + camera.width * camera.height * (5 if eye.rig.has_depth else 1))

    def picture(t_s: float) -> bytes:
        """Return what the slot holds of an image after its head."""
        grey, depth_m = eye.see(follower.at(t_s))
        return grey.tobytes() + (b"" if depth_m is None else depth_m.tobytes())

    try:
        follower = Follower.waiting(cart)
        picture(0.0)  # paints and compiles
        if not life.ready():
            return
        begin_ns, index = epoch.begin_ns(), 0
        while not life.stopped:
            since_s = (time.monotonic_ns() - begin_ns) / _NS
            index = max(index + 1, int(since_s * options.camera_hz))
            t_s = index / options.camera_hz
            time.sleep(max(t_s - since_s, 0.0))
            if any(begin <= t_s < end for begin, end in options.camera_out):
                continue
            body = picture(t_s)
            stamp_ns = begin_ns + round((t_s + options.camera_delay_s) * _NS)
            slot.write(_HEAD.pack(stamp_ns, index, camera.height, camera.width) + body)
    finally:
        slot.close()


class VirtualCamera:
    """Satisfies `FrameSource`."""

    def __init__(self, name: str) -> None:
        """Wait for the camera's process, which paints its world first."""
        self._slot: SlotReader = wait_for(name)
        self._sequence = 0
        self._index: int | None = None
        self._newest_ns = time.monotonic_ns()
        self._counts = {"captured": 0, "dropped": 0}

    def read(self, timeout_s: float) -> Frame | None:
        """Return the newest frame, see `FrameSource`."""
        deadline = time.monotonic() + timeout_s
        while self._slot.sequence == self._sequence:
            if time.monotonic() >= deadline:
                return None
            time.sleep(_POLL_S)
        read = self._slot.read()
        if read is None:
            return None
        self._sequence, data = read[0], bytearray(read[1])  # images that may be written to, as all cameras give
        t_ns, index, height, width = _HEAD.unpack_from(data)
        self._newest_ns = time.monotonic_ns()
        self._counts["captured"] += 1
        self._counts["dropped"] += 0 if self._index is None else index - self._index - 1
        self._index = index
        pixels = height * width
        grey = np.frombuffer(data, np.uint8, pixels, _HEAD.size).reshape(height, width)
        depth: ImageF32 | None = None
        if len(data) > _HEAD.size + pixels:
            depth = np.frombuffer(data, np.float32, pixels, _HEAD.size + pixels).reshape(height, width)
        return Frame(t_ns, index, (grey,), None, depth)

    def health(self) -> Health:
        """Return CAMERA_MISSING after half a second without a frame."""
        return Health.CAMERA_MISSING if time.monotonic_ns() - self._newest_ns > _MISSING_NS else Health(0)

    def counters(self) -> dict[str, int]:
        """Return frames taken, and those that were not rendered or not taken in time."""
        return dict(self._counts)

    def close(self) -> None:
        """Let go of the memory."""
        self._slot.close()
