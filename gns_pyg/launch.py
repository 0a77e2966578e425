"""Starts a command: a Hydra app that ends with a message and status 1, no traceback, where a user can act on it."""

import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import hydra
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from gns_pyg.config import CONF
from gns_pyg.errors import GnsError, StorageError
from gns_pyg.files import REMEDY, held
from gns_pyg.machine import keep_memory

RANKS = ("RANK", "LOCAL_RANK", "SLURM_PROCID")  # as torchrun, Lightning and srun number their processes


def rank() -> int:
    """Number of this process among those that were started together; 0 alone."""
    return next((int(os.environ[name]) for name in RANKS if name in os.environ), 0)


def launch(config_name: str, function: Callable[[DictConfig], Any], configs: str = CONF) -> None:
    """Runs `function` on the composed config of the folder `configs`, once for every job; each holds its run folder
    meanwhile."""

    def job(cfg: DictConfig) -> Any:
        with suppress(ValueError):  # a launcher that runs jobs in threads
            signal.signal(signal.SIGTERM, signal.default_int_handler)  # what a cluster sends: end as on Ctrl-C
        if cfg.get("folder") is None or rank():  # of several processes that train together the first one holds it
            return function(cfg)
        with held(Path(cfg.folder)):
            return function(cfg)

    keep_memory()
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra hands errors on; else it prints a traceback for each
    try:
        hydra.main(config_path=configs, config_name=config_name, version_base="1.3")(job)()
    except BrokenPipeError:  # the reader of --help has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        where = error.filename or "the run folder"
        sys.exit(f"StorageError: {StorageError(where, str(error), 'a file or folder that can be used', REMEDY)}")
    except (GnsError, HydraException, OmegaConfBaseException) as error:
        cause = f"\n{error.__cause__}" if isinstance(error.__cause__, OmegaConfBaseException) else ""
        sys.exit(f"{type(error).__name__}: {error}{cause}")
    except KeyboardInterrupt:
        sys.exit("interrupted; the same command with the same folder (hydra.run.dir=...) goes on")
