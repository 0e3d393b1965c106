# SPDX-License-Identifier: Apache-2.0
"""Messages in MCAP files, which Foxglove and PlotJuggler open."""
