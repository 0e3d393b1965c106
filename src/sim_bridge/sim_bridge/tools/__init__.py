# SPDX-License-Identifier: Apache-2.0
"""Command line tools and a camera for the simulated robot."""
