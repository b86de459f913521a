"""What workers run in the tests: the drills' stand-ins for the engine."""

from service.drills.tasks import PNG, moody, synthetic_payload
from service.drills.tasks import brief as fast

__all__ = ["PNG", "fast", "moody", "synthetic_payload"]
