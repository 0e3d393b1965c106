# SPDX-License-Identifier: Apache-2.0
"""Programs that say what the parameters of a node mean."""
