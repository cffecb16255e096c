"""Optional input ports, read at the price of a connected one."""

from collections.abc import Callable

import numpy as np
from pydrake.systems.framework import Context, InputPort


def optional_input(port: InputPort, otherwise: np.ndarray) -> Callable[[Context], np.ndarray]:
    """A function that gives the value of a vector port, or `otherwise` where it is unconnected.

    To ask first whether the port has a value would cost every event of a connected
    port; so it is asked afterwards, when the value could not be had.

    Parameters
    ----------
    port : InputPort
        A vector-valued port.
    otherwise : array of shape (port.size(),)
        What an unconnected port counts as.
    """
    evaluate, has_value = port.Eval, port.HasValue

    def value(context: Context) -> np.ndarray:
        try:
            return evaluate(context)
        except RuntimeError:
            if has_value(context):
                raise
            return otherwise

    return value
