"""The kernels are compiled before the first test, so that no test is charged for it."""

import pytest

from scanner_service.analysis.compiling import compile_kernels


@pytest.fixture(scope="session", autouse=True)
def compiled():
    compile_kernels()
