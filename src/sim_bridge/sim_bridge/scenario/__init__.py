# SPDX-License-Identifier: Apache-2.0
"""Scenarios, the recording of a run, and its report.

`write_report` is not exported here: it imports matplotlib, which takes a second.
"""

from sim_bridge.scenario.events import Event, read_event
from sim_bridge.scenario.fields import ScenarioError
from sim_bridge.scenario.recording import RecordedRun
from sim_bridge.scenario.scenario import Scenario, load_scenario

__all__ = [
    "Event",
    "RecordedRun",
    "Scenario",
    "ScenarioError",
    "load_scenario",
    "read_event",
]
