# SPDX-License-Identifier: Apache-2.0
"""What the tests of several packages share: nodes in a graph of their own, and settings."""
