# SPDX-License-Identifier: Apache-2.0
"""How several processes share the tests, and which of them coverage is measured of."""

from typing import Any

import pytest

SPREAD = {
    "test/motions/test_demo.py",
    "test/project/test_readme.py",
    "test/installation/test_startup.py",
    "test/safety/test_frozen_states.py",
}
"""Files of tests that share nothing and take long, for any process that has time."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Keep the tests of most files in one process each, because they share what they make."""
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = super()._split_scope(nodeid)
            return nodeid if file in SPREAD else file

    # As in `testpaths`: the long ones first, so that none of them is alone at the end.
    config.option.loadscopereorder = False
    return Scheduling(config, log)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Measure no coverage of the long ones: it takes a third more time."""
    if config.pluginmanager.hasplugin("_cov"):
        for item in items:
            if item.get_closest_marker("long"):
                item.add_marker(pytest.mark.no_cover)
