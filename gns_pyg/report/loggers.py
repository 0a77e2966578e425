"""What a run's loggers get at its end, beside the curves of training: figures, pictures, a table, a moving picture."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.image
from pytorch_lightning.loggers import Logger, TensorBoardLogger, WandbLogger

from gns_pyg.evaluation.metrics import Evaluation
from gns_pyg.report.movie import write_movie
from gns_pyg.scene.scene import Scene


def log_report(
    loggers: Iterable[Logger],
    evaluation: Evaluation,
    scene: Scene,
    figures: Sequence[Path],
    folder: Path,
    update: int,
) -> None:
    """Hands the judgement of a trained model to the run's loggers.

    Every logger gets the figures `test/...` and `speed/...`; wandb and TensorBoard also a table of the cases and the
    plots; wandb a roll-out beside DEM as a moving picture, rollout.gif in the run folder.

    Args:
        loggers: of the trainer.
        evaluation: what to hand over.
        scene: of what was compared.
        figures: files of `write_plots`; the PNGs among them are shown.
        folder: the run folder.
        update: number of the last update.
    """
    numbers = {key: float(value) for key, value in evaluation.metrics.items() if isinstance(value, int | float)}
    pictures = [file for file in figures if file.suffix == ".png"]
    columns, rows = _table(evaluation.per_case)
    for logger in loggers:
        logger.log_metrics(numbers, update)
        if isinstance(logger, WandbLogger):
            logger.log_table("test/cases", columns, rows)
            logger.log_image("test/plots", [str(file) for file in pictures], caption=[file.stem for file in pictures])
            logger.log_video("test/rollout", [str(write_movie(evaluation.cases[0], scene, folder / "rollout.gif"))])
        elif isinstance(logger, TensorBoardLogger):
            board = logger.experiment
            lines = [columns, ["---"] * len(columns), *rows]
            board.add_text("test/cases", "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines), update)
            for file in pictures:
                board.add_image(f"test/{file.stem}", matplotlib.image.imread(file), update, dataformats="HWC")
        logger.save()


def close(loggers: Iterable[Logger]) -> None:
    """Ends wandb's run: the next job of a sweep in this process would go on in it."""
    for logger in loggers:
        if isinstance(logger, WandbLogger):
            logger.experiment.finish()


def _table(cases: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[Any]]]:
    columns = [key for key, value in cases[0].items() if isinstance(value, int | float | str)]
    return columns, [[case.get(key) for key in columns] for case in cases]
