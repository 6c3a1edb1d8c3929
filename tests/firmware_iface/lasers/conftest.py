from collections.abc import Iterator

import pytest

from tests.firmware_iface.lasers.boards import Bench


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    bench.close()
