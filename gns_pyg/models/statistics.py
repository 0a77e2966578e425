"""The scales that make features and targets dimensionless and of order one."""

from dataclasses import dataclass

from gns_pyg.errors import DataError


@dataclass
class Statistics:
    """Root mean squares over the training cases.

    Attributes:
        velocity_m_s: of a velocity component.
        spin_rad_s: of an angular velocity component.
        radius_m: the largest grain radius.
        correction: of each group of targets (see `dynamics.integrator`): m/s, m/s, rad/s.
        position_mean_m, position_std_m: of grain centres; used only by models that see absolute position.
        parameters_mean, parameters_std: over the cases, in the order of `scene.PARAMETERS`; 1 where none varies.
    """

    velocity_m_s: float
    spin_rad_s: float
    radius_m: float
    correction: list[float]
    position_mean_m: list[float]
    position_std_m: float
    parameters_mean: list[float]
    parameters_std: list[float]

    def __post_init__(self) -> None:
        for name in ("velocity_m_s", "position_std_m"):
            if not getattr(self, name) > 0:
                raise DataError(
                    f"statistics.{name}",
                    f"{getattr(self, name)}",
                    "above 0",
                    "nothing moves in the training cases: train on cases that do",
                )
        if not all(scale > 0 for scale in self.correction):
            raise DataError(
                "statistics.correction",
                f"{self.correction}",
                "all above 0",
                "no grain ever leaves free flight in the training cases: nothing to learn",
            )
