"""How tests are spread over processes: a file's tests stay together,
so that what they share is made once.
"""

import pytest


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """By file instead of one by one, unless ``--dist`` asks for something else."""
    from xdist.scheduler import LoadFileScheduling

    return LoadFileScheduling(config, log) if config.getvalue("dist") == "load" else None
