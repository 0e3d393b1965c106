# SPDX-License-Identifier: Apache-2.0
"""Scenarios, the recording of a run, and its report."""
