# SPDX-License-Identifier: Apache-2.0
"""Messages in MCAP files, which Foxglove and PlotJuggler open."""

from sim_bridge.recording.mcap_file import McapFile

__all__ = ["McapFile"]
