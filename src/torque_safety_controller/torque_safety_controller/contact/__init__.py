# SPDX-License-Identifier: Apache-2.0
"""Contact forces: wrist sensor, contacts of the QP and admittance."""

from torque_safety_controller.contact.admittance import AdmittanceGains
from torque_safety_controller.contact.contacts import Contacts, FrictionContact, friction_pyramid
from torque_safety_controller.contact.settings import InteractionSettings
from torque_safety_controller.contact.wrench_sensor import (
    SensorSettings,
    WrenchError,
    WrenchSensor,
)

__all__ = [
    "AdmittanceGains",
    "FrictionContact",
    "Contacts",
    "InteractionSettings",
    "SensorSettings",
    "WrenchError",
    "WrenchSensor",
    "friction_pyramid",
]
