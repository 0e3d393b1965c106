# SPDX-License-Identifier: Apache-2.0
"""Contact forces: wrist sensor, contacts of the QP, admittance and dual compliance."""

from torque_safety_controller.contact.admittance import AdmittanceGains
from torque_safety_controller.contact.contacts import Contacts, FrictionContact, friction_pyramid
from torque_safety_controller.contact.interaction import (
    Compliance,
    Interaction,
    InteractionSettings,
)
from torque_safety_controller.contact.wrench_sensor import (
    SensorSettings,
    WrenchError,
    WrenchSensor,
)

__all__ = [
    "AdmittanceGains",
    "Compliance",
    "FrictionContact",
    "Contacts",
    "Interaction",
    "InteractionSettings",
    "SensorSettings",
    "WrenchError",
    "WrenchSensor",
    "friction_pyramid",
]
