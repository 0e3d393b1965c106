# SPDX-License-Identifier: Apache-2.0
"""What the controller node tells about itself: diagnostics, and topics for plots."""
