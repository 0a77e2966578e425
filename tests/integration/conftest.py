import pytest

from tests.integration.runs import train


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return folder, train(folder, "experiment=hopper", "training.updates=20", "training.unroll_from=0")
