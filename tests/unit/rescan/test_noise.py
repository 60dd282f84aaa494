"""The running median does not depend on the pieces in which it is taken."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import median_filter

from scanner_service.rescan import noise


@given(count=st.integers(21, 400), piece=st.integers(11, 150), seed=st.integers(0, 2**32 - 1))
def test_the_running_median_is_that_of_the_whole_whatever_the_pieces(count: int, piece: int, seed: int) -> None:
    values = np.random.default_rng(seed).random(count)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(noise, "_PIECE", piece)
        np.testing.assert_array_equal(noise._running_median(values), median_filter(values, size=21, mode="nearest"))
