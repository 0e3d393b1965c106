# SPDX-License-Identifier: Apache-2.0
"""What users declare to be uncertain, and the margins that the bounds keep for it."""
