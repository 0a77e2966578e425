"""Errors that a user can act on: where it went wrong, what was found, what was expected, what to do."""


class GnsError(Exception):
    """Base of every error this package raises on purpose.

    Args:
        where: the file, config key or step that is wrong.
        found: what is there.
        expected: what should be there.
        remedy: what the user can do about it.
    """

    def __init__(self, where: object, found: str, expected: str, remedy: str) -> None:
        self.where, self.found, self.expected, self.remedy = str(where), found, expected, remedy
        super().__init__(str(self))

    def __reduce__(self):
        return type(self), (self.where, self.found, self.expected, self.remedy)

    def __str__(self) -> str:
        return f"{self.where}\n  found:    {self.found}\n  expected: {self.expected}\n  remedy:   {self.remedy}"


class ConfigError(GnsError):
    """A config key that is unknown, missing, of the wrong type or out of range."""


class DataError(GnsError):
    """A trajectory file or data set that cannot be used."""


class GeometryError(GnsError):
    """A mesh that cannot serve as a boundary, or grains that do not fit into it."""


class BundleError(GnsError):
    """A trained bundle that cannot be loaded."""


class CheckpointError(GnsError):
    """A checkpoint that cannot be read or resumed from."""


class StorageError(GnsError):
    """A file that cannot be written: no room, no permission."""


class NumericalError(GnsError):
    """A value that is not finite, or a limit that was reached while computing."""


class DependencyError(GnsError):
    """A program or package that is needed here is not installed."""
