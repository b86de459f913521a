"""What can go wrong in the engine, one exception for each meaning.

Every exception carries the name of the quantity, the value it had and what is allowed, so that a caller can repeat
all three to the person who asked. Nothing in the engine returns a sentinel number instead of raising.
"""

from __future__ import annotations

_LONGEST_VALUE = 80


def shown(value: object) -> object:
    """A value to be repeated in a message, or what it is where that would be too long."""
    if isinstance(value, int) and value.bit_length() > 4 * _LONGEST_VALUE:
        return f"a number of {value.bit_length()} bits"
    if (isinstance(value, dict | list | tuple) and len(value) > _LONGEST_VALUE) or len(repr(value)) > _LONGEST_VALUE:
        if isinstance(value, dict):
            return f"a table of {len(value)} fields"
        if isinstance(value, list | tuple):
            return f"a list of {len(value)} entries"
        return f"{str(value)[:_LONGEST_VALUE]}..."
    return value


class EngineError(Exception):
    """Base of every error that the engine raises on purpose."""


class SpecError(EngineError, ValueError):
    """A specification is not acceptable: which field, which value, what is allowed."""

    def __init__(self, field: str, value: object, allowed: str) -> None:
        super().__init__(f"{field}: got {shown(value)!r}, allowed is {allowed}")
        self.field = field
        self.value = value
        self.allowed = allowed

    def __reduce__(self) -> tuple[type[SpecError], tuple[str, object, str]]:
        """Rebuild from the three parts, so that the error survives the way back from a worker."""
        return SpecError, (self.field, self.value, self.allowed)


class ObservationError(EngineError, ValueError):
    """An observation cannot be analysed (shapes, non-finite pixels, an empty mask)."""


class LensEquationError(EngineError, ArithmeticError):
    """The images of a source could not all be found."""


class InversionError(EngineError, ArithmeticError):
    """A linear inversion cannot be trusted: the matrix is not positive definite, or no ray reaches the source."""


class PosteriorError(EngineError, ArithmeticError):
    """No starting point with a finite posterior was found, or the chain cannot be run from it."""


class StudyError(EngineError, ValueError):
    """A file is not one of a study."""


class AccuracyError(EngineError):
    """What is asked for, or was measured, makes no report of speed against error."""


class FigureError(EngineError, ValueError):
    """A figure cannot be drawn from what it was given; the message says what it got and what is allowed."""


class NothingToShowError(FigureError):
    """No result is left to draw: none was given, or none of them has what the figure shows."""
