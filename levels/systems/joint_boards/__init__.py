"""Boards that servo the joints of one arm, the board of the arm, and a gateway to a level above."""

from rack.levels.systems.joint_boards.arm_executor import ArmExecutor
from rack.levels.systems.joint_boards.gateway import JointGateway, NetworkGateway
from rack.levels.systems.joint_boards.joint_servo import JointServo
from rack.levels.systems.joint_boards.modified_from_afar import (
    ModificationSender,
    ModifiedFromAfar,
)

__all__ = [
    "ArmExecutor",
    "JointGateway",
    "JointServo",
    "ModificationSender",
    "ModifiedFromAfar",
    "NetworkGateway",
]
