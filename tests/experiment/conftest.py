"""What tests of comparisons share."""

import pytest
from tiny import jobs_here


@pytest.fixture
def jobs_in_this_process():
    with jobs_here():
        yield
