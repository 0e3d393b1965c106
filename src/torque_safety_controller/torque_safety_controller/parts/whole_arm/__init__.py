# SPDX-License-Identifier: Apache-2.0
"""Safety filter of the whole arm: a braking plan that keeps every limit is always known."""
