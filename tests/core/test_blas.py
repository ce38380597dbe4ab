"""Work of vislam takes one thread of BLAS, whatever the program around it has; and gives them back."""

from threadpoolctl import threadpool_info, threadpool_limits

from vislam import Window
from vislam.batch import optimize_pose_graph, optimize_run
from vislam.core.blas import on_one_blas_thread
from vislam.pipeline import Back, Front


def threads():
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_a_function_computes_on_one_thread_and_gives_the_others_back():
    with threadpool_limits(2, user_api="blas"):
        assert on_one_blas_thread(threads)() == {1}
        assert threads() == {2}


def test_what_owns_long_work_is_bounded():
    for function in (Front.process, Back.add, Back.finish, Window.add, optimize_run, optimize_pose_graph):
        assert function.__wrapped__.__name__ == function.__name__
