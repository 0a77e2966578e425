"""Small configs and made-up rows of a trade-off."""

from hydra import compose, initialize_config_dir

from gns_pyg.config import CONF

TINY = [
    "sweeps=[state]",
    'overrides=["model.hidden=8","model.layers=1","training.batch_size=1","training.unroll=1"]',
    "shipped=null",
    'without_training=[{of:["requires.state=velocity"],with:["projection_sweeps=1"]}]',
    "dem_steps_s=[]",
    "budget_cpu_s=0.5",
    "start_s=1.15",
]


def config(results, *overrides):
    with initialize_config_dir(f"{CONF}/tradeoff", version_base="1.3"):
        return compose("tradeoff", [f"results={results}", *overrides])


def row(name, seconds, center_m=0.01, angle_deg=1.0, kind="trained", error=None, **more):
    """A row with these mean errors in both cases."""
    told = {"center_of_mass_error_m": center_m, "angle_of_repose_error_deg": angle_deg, "escaped_grains": 0.0}
    axes = {key: {"mean": v, "least": v, "most": v, "cases": [v, v]} for key, v in told.items()}
    time = None if seconds is None else {"cpu_s_per_simulated_s": seconds, "processor": "some processor"}
    found = {"name": name, "kind": kind, "training": [name], "running": [], "error": error, "axes": axes, "time": time}
    return found | {"within_scatter": False} | more


def yade(dt_s, seconds, center_m, **more):
    return row(f"Yade, dt = {dt_s} s", seconds, center_m, kind="yade", dt_s=dt_s, **more) | {"training": [str(dt_s)]}


def seeds(center_m=0.02, angle_deg=2.0):
    return row("Yade, another seed", None, center_m, angle_deg, kind="seeds")
