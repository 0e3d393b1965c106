# SPDX-License-Identifier: Apache-2.0
"""The arm as a whole: steps after which a plan is known that keeps every limit for ever."""
