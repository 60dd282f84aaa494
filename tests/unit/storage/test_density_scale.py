"""The scale of a density picture shows most points apart, and always where what is required lies."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from scanner_service.storage.exports.density_scale import scale_of

densities = arrays(np.float64, st.integers(0, 200), elements=st.one_of(st.floats(0, 1e5), st.just(np.nan)))
required = st.one_of(st.just(np.nan), st.floats(1e-3, 1e4))


@given(densities, required)
def test_a_scale_rises_holds_nearly_all_points_and_has_the_requirement_in_its_middle(found, asked):
    scale = scale_of(found, asked)
    assert 0.0 <= scale.bottom < scale.middle < scale.top
    assert scale.share(np.array([scale.middle]))[0] == 0.5
    if np.isfinite(asked):
        assert scale.middle == asked
    known = found[np.isfinite(found)]
    outside = np.count_nonzero((known < scale.bottom) | (known > scale.top))
    assert outside <= 0.02 * len(known) + 2
    along = scale.share(np.linspace(scale.bottom, scale.top, 50))
    assert (np.diff(along) > 0).all()
    assert (along[0], along[-1]) == (0.0, 1.0)


def test_densities_that_lie_together_get_most_of_the_colours_and_outliers_do_not_take_them():
    rng = np.random.default_rng(1)
    found = np.concatenate([rng.uniform(44.0, 56.0, 5000), [0.5, 900.0]])
    shares = scale_of(found).share(found[:-2])
    assert np.ptp(shares) > 0.9
    shares = scale_of(found, 50.0).share(found[:-2])
    assert np.ptp(shares) > 0.4
    assert ((shares < 0.5) == (found[:-2] < 50.0)).all(), "what misses the requirement has colours of its own"


def test_what_lies_beyond_the_scale_has_the_colour_of_its_end_and_nan_has_none():
    scale = scale_of(np.array([10.0, 20.0]), 15.0)
    assert scale.share(np.array([-1.0, 1e9])).tolist() == [0.0, 1.0]
    assert np.isnan(scale.share(np.array([np.nan]))).all()
