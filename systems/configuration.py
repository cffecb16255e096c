"""How a block's configuration is declared: a dataclass beside its system.

A configuration is a plain dataclass with defaults, one commented field a line,
validated on construction and on assignment::

    @configuration
    class BarometerConfig:
        period: Seconds = 0.04      # s
        noise: Metres = 0.08        # m, one sigma

        def add_to(self, builder: DiagramBuilder, name: str, seed: int) -> Barometer: ...

Every system takes `(config, seed)` in its constructor and in `configure`, so
that a campaign re-uses one diagram: `configure` may change every field except
those that shape the diagram (periods, sizes), which raise `StructureChangedError`.
"""

from collections.abc import Callable
from typing import Annotated, Any, dataclass_transform

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as pydantic_dataclass

Seconds = Annotated[float, Field(ge=0.0, allow_inf_nan=False, description="a time in seconds")]
Metres = Annotated[float, Field(ge=0.0, allow_inf_nan=False, description="a length in metres")]
Probability = Annotated[
    float, Field(ge=0.0, le=1.0, allow_inf_nan=False, description="a probability from 0 to 1")
]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False, description="a number >= 0")]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False, description="a number > 0")]
Finite = Annotated[float, Field(allow_inf_nan=False, description="a finite number")]
Vector2 = Annotated[list[Finite], Field(min_length=2, max_length=2, description="two numbers")]
Vector3 = Annotated[list[Finite], Field(min_length=3, max_length=3, description="three numbers")]


@dataclass_transform(kw_only_default=True, field_specifiers=(Field,))
def configuration(cls: type) -> Any:
    """Make `cls` a validated keyword-only dataclass that refuses unknown fields."""
    decorate: Callable[[type], Any] = pydantic_dataclass(
        config=ConfigDict(extra="forbid", validate_assignment=True), kw_only=True
    )
    return decorate(cls)


class StructureChangedError(ValueError):
    """A field that shapes the diagram differs from the one the diagram was built with."""


def require_same_structure(old: Any, new: Any, *fields: str) -> None:
    """Raise `StructureChangedError` if one of `fields` differs between two configurations."""
    for field in fields:
        if getattr(old, field) != getattr(new, field):
            raise StructureChangedError(
                f"{type(new).__name__}.{field} is built into the diagram "
                f"({getattr(old, field)!r}) and cannot become {getattr(new, field)!r}: "
                "build a new diagram"
            )
