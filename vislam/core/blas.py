"""BLAS on one thread: the matrices here are small, so threads cost more than they bring, and change last bits."""

from collections.abc import Callable
from functools import cache, wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController

Given = ParamSpec("Given")
Result = TypeVar("Result")


def on_one_blas_thread(function: Callable[Given, Result]) -> Callable[Given, Result]:
    """Decorate a function to compute on one thread of BLAS and give the others back after it; 0.1 ms a call."""

    @wraps(function)
    def limited(*values: Given.args, **named: Given.kwargs) -> Result:
        with _libraries().limit(limits=1):
            return function(*values, **named)

    return limited


@cache
def _libraries() -> ThreadpoolController:
    import scipy.linalg  # noqa: F401  # brings a BLAS of its own

    return ThreadpoolController().select(user_api="blas")
