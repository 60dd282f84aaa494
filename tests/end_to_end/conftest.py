"""Services and simulators that end with the test."""

import contextlib

import pytest

from tests.end_to_end.running import RunningService, RunningSimulator


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
