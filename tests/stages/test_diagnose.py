"""What the stage is asked to leave out."""

from __future__ import annotations

import pytest

from bampipe.errors import InputError
from bampipe.physics import registry
from bampipe.physics.recipe import Recipe
from bampipe.stages.diagnose import _require_known


def test_what_is_no_effect_cannot_be_left_out() -> None:
    recipe = Recipe(registry.device("slider").declaration, (), ())
    _require_known(("backlash:carriage",), recipe)
    with pytest.raises(InputError, match="no effect of this device, did you mean 'backlash:"):
        _require_known(("backlsh:carriage",), recipe)
