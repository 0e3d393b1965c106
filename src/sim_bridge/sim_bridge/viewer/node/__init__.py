# SPDX-License-Identifier: Apache-2.0
"""The node that shows what comes on the topics, and publishes what the user of the page does."""
