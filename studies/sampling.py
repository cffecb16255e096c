"""What varies at random in a study: distributions, drawn as a pure function of the pair.

A draw is a hash of (study, pair, path), so the n-th pair of a study sees the
same world in every variant (common random numbers), whoever flies it and
however many pairs follow.
"""

import bisect
import hashlib
import itertools
import math
from statistics import NormalDist
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from systems.configuration import Finite, NonNegative, Positive, configuration

_DOUBLE_BITS = 53  # significant bits of a double


def hashed(*coordinates: object) -> int:
    """A uniform integer of 53 bits, a pure function of its coordinates."""
    text = "/".join(str(coordinate) for coordinate in coordinates)
    digest = hashlib.blake2b(text.encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> (64 - _DOUBLE_BITS)


def hashed_uniform(*coordinates: object) -> float:
    """A draw from the open interval (0, 1), a pure function of its coordinates."""
    return (hashed(*coordinates) + 0.5) / (1 << _DOUBLE_BITS)


def _in_order(law: Any) -> Any:
    """`law`, unless its limits `low` and `high`, where it has both, are in the wrong order."""
    low, high = law.low, law.high
    if low is not None and high is not None and low > high:
        raise ValueError(f"expected low <= high, found {low} and {high}")
    return law


@configuration
class Uniform:
    """Every value between two limits is equally likely."""

    kind: Literal["uniform"] = "uniform"
    low: Finite
    high: Finite

    _ordered = model_validator(mode="after")(_in_order)

    def quantile(self, u: float) -> float:
        """The value below which the fraction `u` in (0, 1) of all draws lie."""
        return self.low + u * (self.high - self.low)


@configuration
class Normal:
    """A normal distribution, cut off at the limits if there are any."""

    kind: Literal["normal"] = "normal"
    mean: Finite
    sigma: Positive
    low: Finite | None = None
    high: Finite | None = None

    _ordered = model_validator(mode="after")(_in_order)

    @model_validator(mode="after")
    def _leaves_something(self) -> "Normal":
        below, above = self._tails()
        if not below < above:
            raise ValueError("the limits leave nothing of the normal distribution")
        return self

    def _tails(self) -> tuple[float, float]:
        normal = NormalDist(self.mean, self.sigma)
        return (
            0.0 if self.low is None else normal.cdf(self.low),
            1.0 if self.high is None else normal.cdf(self.high),
        )

    def quantile(self, u: float) -> float:
        """The value below which the fraction `u` in (0, 1) of all draws lie."""
        below, above = self._tails()
        value = NormalDist(self.mean, self.sigma).inv_cdf(below + u * (above - below))
        if self.low is not None:
            value = max(value, self.low)
        return value if self.high is None else min(value, self.high)


@configuration
class LogUniform:
    """Every order of magnitude between two limits is equally likely."""

    kind: Literal["log_uniform"] = "log_uniform"
    low: Positive
    high: Positive

    _ordered = model_validator(mode="after")(_in_order)

    def quantile(self, u: float) -> float:
        """The value below which the fraction `u` in (0, 1) of all draws lie."""
        value = self.low * math.exp(u * math.log(self.high / self.low))
        return min(max(value, self.low), self.high)


@configuration
class UniformInteger:
    """Every integer from `low` to `high`, both included, is equally likely."""

    kind: Literal["uniform_integer"] = "uniform_integer"
    low: int
    high: int

    _ordered = model_validator(mode="after")(_in_order)

    def quantile(self, u: float) -> int:
        """The value below which the fraction `u` in (0, 1) of all draws lie."""
        return self.low + math.floor(u * (self.high - self.low + 1))


@configuration
class Choice:
    """One of some values, equally likely or by weight."""

    kind: Literal["choice"] = "choice"
    values: Annotated[list[Any], Field(min_length=1)]
    weights: list[NonNegative] | None = None  # one a value, any sum

    @model_validator(mode="after")
    def _weighted(self) -> "Choice":
        if self.weights is not None:
            if len(self.weights) != len(self.values):
                raise ValueError(
                    f"expected one weight for each of the {len(self.values)} values, "
                    f"found {len(self.weights)}"
                )
            if not sum(self.weights) > 0.0:
                raise ValueError("expected at least one weight above 0")
        return self

    def quantile(self, u: float) -> Any:
        """The value whose share of (0, 1), in the order of `values`, holds `u`."""
        edges = list(itertools.accumulate(self.weights or [1.0] * len(self.values)))
        return self.values[min(bisect.bisect_right(edges, u * edges[-1]), len(edges) - 1)]


Distribution = Annotated[
    Uniform | Normal | LogUniform | UniformInteger | Choice, Field(discriminator="kind")
]
