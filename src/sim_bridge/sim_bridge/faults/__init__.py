# SPDX-License-Identifier: Apache-2.0
"""What can go wrong with the messages between the nodes, over time, and how it is done to them."""
