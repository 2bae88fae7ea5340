"""Options of rounds and opinions that make no sense are refused."""

import pytest
from mvrecon.models.cross_view.model import CrossView

from tests.models.rig import small_projector


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"opinions": {}}, ValueError, "opinions in a round with cameras, got cameras: null"),
        ({"cameras": {"name": "rays2d", "correct": False}}, ValueError, "got neither"),
        (
            {"cameras": {"name": "rays2d"}, "opinions": {"fusion": "median"}},
            ValueError,
            "weighted or mean, got 'median'",
        ),
        (
            {"cameras": {"name": "rays2d"}, "opinions": {"prior": "flat"}},
            ValueError,
            "learned or uniform, got 'flat'",
        ),
        (
            {"cameras": {"name": "rays2d"}, "opinions": {"places": "all"}},
            ValueError,
            "places as residual or view, got 'all'",
        ),
        (
            {"cameras": {"name": "rays2d"}, "opinions": {"resolution": "double"}},
            ValueError,
            "resolution of opinions as quarter, half, full, got 'double'",
        ),
        (
            {"cameras": {"name": "rays2d"}, "opinions": {"resolution": "full"}},
            ValueError,
            "one of the scales of the round's network, got full where 3 begin at half",
        ),
        (
            {"widths": [4], "cameras": {"name": "rays2d"}, "opinions": {"resolution": "quarter"}},
            ValueError,
            "one of the scales of the round's network, got quarter where 1 begin at half",
        ),
        (
            {"cameras": {"name": "rays2d"}, "opinions": {"widths": [0]}},
            ValueError,
            "network that weighs opinions as positive numbers",
        ),
        (
            {"cameras": {"name": "rays2d"}, "opinions": {"feature": 3}},
            TypeError,
            "no option 'feature'; did you mean 'features'",
        ),
        (
            {"cameras": {"name": "rays2d"}, "opinions": {"head": {"name": "softmax"}}},
            LookupError,
            "did you mean 'softmax_depth'",
        ),
    ],
)
def test_opinions_that_make_no_sense_are_refused(options, error, message):
    """Opinions of cameras that there are not, and options that they do not have, are refused."""
    with pytest.raises(error, match=message):
        CrossView(small_projector(), [options])
