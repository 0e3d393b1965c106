# SPDX-License-Identifier: Apache-2.0
"""What can go wrong with the messages between the nodes, over time, and how it is done to them."""

from sim_bridge.faults.fault import FAULTS, Fault, Passage
from sim_bridge.faults.faulty_stream import FaultyStream
from sim_bridge.faults.timeline import Timeline, TimelineError, load_timeline

__all__ = [
    "FAULTS",
    "Fault",
    "FaultyStream",
    "Passage",
    "Timeline",
    "TimelineError",
    "load_timeline",
]
