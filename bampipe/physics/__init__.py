"""The physics: devices, effects, and the compiled model made of them.

Knows nothing of files of a lab, screens or estimators. A *device* is its energies, an *effect* is
one physical term, a *model* is a device plus effects, a *system* is the model's generated code.
"""

from bampipe.physics.model import Model
from bampipe.physics.system import System, compile_model

__all__ = ["Model", "System", "compile_model"]
