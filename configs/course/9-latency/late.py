"""The servo level of NASREM with a law that gets old samples."""

from collections import deque

from rack.levels.servo import SensedMotion, ServoExecutor
from rack.levels.servo.control import ServoParams


class LateParams(ServoParams):
    late: int = 0
    """age of the samples that the law gets, in cycles"""


class LateServo(ServoExecutor):
    """Delays the samples on their way to the law."""

    params = LateParams

    def __init__(self, context):
        super().__init__(context)
        self.samples = deque(maxlen=self.settings.late + 1)

    def torques(self, set_point, sensed):
        self.samples.append(SensedMotion(sensed.table.copy()))
        return super().torques(set_point, self.samples[0])
