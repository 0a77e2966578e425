"""From plain config values to typed records: every key known, every type checked, one clear error."""

from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar, cast

from omegaconf import OmegaConf

from gns_pyg.errors import ConfigError, GnsError

CONF = str(Path(__file__).resolve().parent / "conf")

Record = TypeVar("Record")


def typed(record: type[Record], values: Any, where: str) -> Record:
    """Turns a mapping (a Hydra config node or a plain dict) into the dataclass `record`.

    Args:
        record: a dataclass; its fields and their types are the schema.
        values: mapping of keys to values; interpolations are resolved.
        where: the config path that errors name, e.g. "scene".

    Raises:
        ConfigError: for an unknown or missing key or a value of the wrong type.
    """
    if not isinstance(values, Mapping) and not OmegaConf.is_dict(values):
        raise ConfigError(where, repr(values), f"a mapping with the keys of {record.__name__}", "see conf/")
    try:
        told = OmegaConf.to_container(values, resolve=True) if OmegaConf.is_config(values) else values
        merged = OmegaConf.merge(OmegaConf.structured(record), told)
        return cast(Record, OmegaConf.to_object(merged))
    except GnsError:
        raise
    except Exception as error:  # OmegaConf's own, and whatever a record trips over that is given something else
        key = getattr(error, "full_key", None)
        reason = (str(error) or type(error).__name__).splitlines()[0]
        known = ", ".join(field.name for field in fields(record))  # type: ignore[arg-type]
        raise ConfigError(
            f"{where}.{key}" if key else where,
            reason,
            f"the keys of {where} are: {known}",
            "correct the key or value; `python train.py --cfg job` prints the whole config",
        ) from None


def check_keys(config: Any, known: Iterable[str]) -> None:
    """Raises ConfigError for a top-level key that is not `known`: Hydra adds whatever +key=value says."""
    unknown = sorted(set(config) - set(known))
    require(not unknown, unknown[0] if unknown else "", "not a key", f"one of {', '.join(sorted(known))}", "remove it")


def plain(config: Any) -> Any:
    """Returns `config` (a Hydra node or a dataclass) as plain dicts, lists, strings and numbers."""
    node = config if OmegaConf.is_config(config) else OmegaConf.structured(config)
    return OmegaConf.to_container(node, resolve=True)


def require(condition: bool, where: str, found: object, expected: str, remedy: str) -> None:
    """Raises ConfigError unless `condition` holds."""
    if not condition:
        raise ConfigError(where, str(found), expected, remedy)


def flat(values: Any, prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one level of dotted keys."""
    if not isinstance(values, Mapping):
        return {prefix: values}
    return {key: leaf for name in values for key, leaf in flat(values[name], f"{prefix}.{name}".lstrip(".")).items()}
