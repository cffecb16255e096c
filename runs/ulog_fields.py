"""One topic of a ULog, whatever it and its fields are called in this version of PX4."""

from collections.abc import Mapping

import numpy as np

Topic = Mapping[str, np.ndarray]


class MissingFieldError(ValueError):
    """A topic lacks a field that it should have."""


class Fields:
    """The fields of one topic as float64, in order of time.

    Parameters
    ----------
    topics : mapping
        All topics of the log.
    names : str
        Of the topic; the first one that the log has is taken.
    """

    def __init__(self, topics: Mapping[str, Topic], *names: str):
        self.name = next((name for name in names if name in topics), names[0])
        self._data = topics.get(self.name, {})
        self._order = np.argsort(self("timestamp"), kind="stable") if self._data else None

    def __bool__(self) -> bool:
        return bool(self._data) and len(self._data["timestamp"]) > 0

    def __contains__(self, field_name: str) -> bool:
        return field_name in self._data

    def __call__(self, *names: str, default: float | None = None) -> np.ndarray:
        """The first of these fields that the topic has, shape (n,).

        Raises
        ------
        MissingFieldError
            If it has none of them and there is no default.
        """
        for field_name in names:
            if field_name in self._data:
                values = np.asarray(self._data[field_name], dtype=float)
                order = getattr(self, "_order", None)
                return values if order is None else values[order]
        if default is None or "timestamp" not in self._data:
            raise MissingFieldError(f"topic {self.name}: expected a field {' or '.join(names)}")
        return np.full(len(self._data["timestamp"]), default)

    def vector(self, name: str, size: int, default: float | None = None) -> np.ndarray:
        """An array field, shape (n, size)."""
        return np.column_stack([self(f"{name}[{i}]", default=default) for i in range(size)])


def sample_times(topic: Fields) -> np.ndarray:
    """When each sample was measured (us), its publication where the driver did not say."""
    published, sampled = topic("timestamp"), topic("timestamp_sample", default=0.0)
    return np.where(sampled > 0.0, sampled, published)
