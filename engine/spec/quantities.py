"""What numbers and names of a specification may be: one statement for files, grids and the schema of the API."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, ConfigDict, Field, Strict

from engine.spec.validation import DECIMAL, IDENTIFIER

STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)
# Strict, or a file's true would be the number 1 and its "20.5" a number. What stands here is the one statement of what
# is allowed: files, grids and the API's schema are made of these types.
# A negative zero is read as zero: the two are equal, and JSON would make two digests of them. It stands behind the
# bounds of every number that can be zero, or the schema would not know them for bounds.
UNSIGNED = AfterValidator(lambda number: number + 0.0)
Number = Annotated[float, Strict()]
Count = Annotated[int, Strict()]
Flag = Annotated[bool, Strict()]
AxisRatio = Annotated[Number, Field(ge=0.05, le=1.0)]
Angle = Annotated[Number, Field(ge=-360.0, le=360.0), UNSIGNED]
Magnitude = Annotated[Number, Field(ge=5.0, le=40.0)]
SersicIndex = Annotated[Number, Field(ge=0.3, le=10.0)]
Radius = Annotated[Number, Field(gt=1e-4, le=60.0)]
Coordinate = Annotated[Number, Field(ge=-60.0, le=60.0), UNSIGNED]
Position = tuple[Coordinate, Coordinate]
Positive = Annotated[Number, Field(gt=0.0, le=1e9)]
NotNegative = Annotated[Number, Field(ge=0.0, le=1e9), UNSIGNED]
Bound = Annotated[Number, Field(ge=-1e6, le=1e6), UNSIGNED]
Slope = Annotated[Number, Field(ge=0.2, le=1.8)]
Seed = Annotated[Count, Field(ge=0, le=2**63 - 1)]
Fraction = Annotated[Number, Field(ge=0.0, lt=1.0), UNSIGNED]
Scale = Annotated[Number, Field(gt=0.0001, le=1.0)]
Shear = Annotated[Number, Field(ge=-0.7, le=0.7), UNSIGNED]
Shift = Annotated[Count, Field(ge=-64, le=64)]
Identifier = Annotated[str, Field(min_length=1, max_length=64, pattern=IDENTIFIER)]
SlopeKey = Annotated[str, Field(pattern=DECIMAL)]
