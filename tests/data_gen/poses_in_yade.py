"""Runs in Yade's Python instead of data_gen/yade_case.py: that, and every frame's facet corners go to $GNS_POSES."""

import os
import runpy
import sys
from pathlib import Path

import numpy as np
from yade import O
from yade.wrapper import Facet

ROOT = Path(sys.argv[0]).resolve().parents[2]
sys.argv[2] = str(ROOT)
sys.path.append(str(ROOT))
from gns_pyg.data.trajectory import TrajectoryWriter  # noqa: E402

frames = []
append, finish = TrajectoryWriter.append, TrajectoryWriter.finish


def append_and_record(self, *arguments):
    facets = [body for body in O.bodies if isinstance(body.shape, Facet)]
    frames.append([[body.state.pos + body.state.ori * v for v in body.shape.vertices] for body in facets])
    append(self, *arguments)


def finish_and_save(self, *arguments):
    np.save(os.environ["GNS_POSES"], np.array(frames, np.float64))
    finish(self, *arguments)


TrajectoryWriter.append, TrajectoryWriter.finish = append_and_record, finish_and_save
runpy.run_path(str(ROOT / "data_gen" / "yade_case.py"), run_name="__main__")
