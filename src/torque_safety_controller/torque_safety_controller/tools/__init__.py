# SPDX-License-Identifier: Apache-2.0
"""Command line tools that read parameters as the nodes do."""
