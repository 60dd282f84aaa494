"""Services and simulators that end with the test."""

import contextlib

import pytest

from tests.end_to_end.running import RunningService, RunningSimulator


@pytest.fixture(scope="session")
def shared_service(tmp_path_factory):
    """One service for all files of a worker."""
    shared = RunningService(tmp_path_factory.mktemp("shared") / "data")
    yield shared
    shared.end()


@pytest.fixture
def running(tmp_path):
    """Start services (on one data folder) and simulators; all of them end with the test, the services first."""
    with contextlib.ExitStack() as simulators, contextlib.ExitStack() as services:

        class Starter:
            data = tmp_path / "data"

            def service(self):
                service = RunningService(self.data)
                services.callback(service.end)
                return service

            def simulator(self, *arguments):
                simulator = RunningSimulator(*arguments)
                simulators.callback(simulator.end)
                return simulator

        yield Starter()


@pytest.fixture
def service(running, shared_service):
    """The service of the worker, for tests that neither end it nor mind the sessions of others.

    What a test leaves is stopped while its simulator still runs: a session that looked for a terminal which is gone
    would open the next one of that number, which may be another test's.
    """
    yield shared_service
    shared_service.stop_all()
