# SPDX-License-Identifier: Apache-2.0
"""Forces at the hand: wrist sensor, contact of the QP, admittance and dual compliance."""
