# SPDX-License-Identifier: Apache-2.0
"""Scenario files, the recording of a run, and its report."""
