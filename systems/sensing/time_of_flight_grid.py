"""TimeOfFlightGrid: what a policy sees of a time-of-flight sensor."""

from typing import cast

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, LeafSystem
from pydrake.systems.sensors import ImageDepth32F

from splatpilot.systems.ports import input_port, output_port
from splatpilot.systems.sensing.time_of_flight import TimeOfFlight, time_of_flight_grid


class TimeOfFlightGrid(LeafSystem):
    """Turns raw frames into grids of proximities, see `time_of_flight_grid`.

    .. pydrake_system::

        name: TimeOfFlightGrid
        input_ports:
        - depth_image_32f
        output_ports:
        - depth_grid

    - ``depth_image_32f``: planar depth [m], of the sensor's size.
    - ``depth_grid`` (rows * columns): 1 - range / max_range, row by row from the lowest.

    Stateless.

    Raises:
        ValueError: from the constructor on a configuration out of range.
    """

    depth_image_32f_input_port = input_port("depth_image_32f")
    depth_grid_output_port = output_port("depth_grid")

    def __init__(self, sensor: TimeOfFlight | None = None):
        super().__init__()
        self._sensor = sensor = sensor or TimeOfFlight()
        sensor.validate()
        image = self.DeclareAbstractInputPort(
            "depth_image_32f", Value(ImageDepth32F(sensor.width, sensor.height))
        )
        size = sensor.rows * sensor.columns
        self.DeclareVectorOutputPort("depth_grid", size, self._calc, {image.ticket()})

    def _calc(self, context: Context, output: BasicVector) -> None:
        image = cast(ImageDepth32F, self.get_input_port().Eval(context))
        grid = time_of_flight_grid(np.asarray(image.data)[..., 0], self._sensor)
        output.SetFromVector(grid.ravel())
