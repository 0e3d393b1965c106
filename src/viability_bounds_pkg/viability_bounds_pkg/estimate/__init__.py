# SPDX-License-Identifier: Apache-2.0
"""Inside the estimate of acceleration limits: worst states, zero-order hold error."""
