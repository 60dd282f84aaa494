"""Services and simulators that end with the test."""

import contextlib

import pytest

from tests.end_to_end.running import RunningService, RunningSimulator


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    """One service for all tests of a file that neither end it nor mind the sessions of others."""
    shared = RunningService(tmp_path_factory.mktemp("shared") / "data")
    yield shared
    shared.end()


@pytest.fixture
def running(tmp_path):
    """Start services (on one data folder) and simulators; all of them end with the test."""
    with contextlib.ExitStack() as stack:

        class Starter:
            data = tmp_path / "data"

            def service(self):
                service = RunningService(self.data)
                stack.callback(service.end)
                return service

            def simulator(self, *arguments):
                simulator = RunningSimulator(*arguments)
                stack.callback(simulator.end)
                return simulator

        yield Starter()
