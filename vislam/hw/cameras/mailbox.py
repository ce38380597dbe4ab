"""A slot for the newest image: what is not taken in time is replaced, and counted."""

import threading
from typing import Generic, TypeVar

Shot = TypeVar("Shot")


class Mailbox(Generic[Shot]):
    """Hands images from the thread that captures to the one that uses them."""

    def __init__(self) -> None:
        self.replaced = 0
        self._changed = threading.Condition()
        self._image: Shot | None = None
        self._is_closed = False

    def put(self, image: Shot) -> None:
        """Leave an image in place of the one that may still be there."""
        with self._changed:
            self.replaced += self._image is not None
            self._image = image
            self._changed.notify_all()

    def wait_until_empty(self, timeout_s: float) -> bool:
        """Return whether the last image was taken, waiting at most `timeout_s`."""
        with self._changed:
            return self._changed.wait_for(lambda: self._image is None or self._is_closed, timeout_s)

    def take(self, timeout_s: float) -> Shot | None:
        """Return the image, waiting at most `timeout_s` for one; None if none came."""
        with self._changed:
            self._changed.wait_for(lambda: self._image is not None or self._is_closed, timeout_s)
            image, self._image = self._image, None
            self._changed.notify_all()
            return image

    def close(self) -> None:
        """End all waiting."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
