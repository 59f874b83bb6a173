"""Model of a scene as named tuples of float64: its parts, the state of a contact, and the result of a step.

A missing part is None; the kernel for None does nothing, so the part costs no code.
Lengths m, forces N, angles rad; vectors (3,) in the world frame unless stated; quaternions w, x, y, z.
"""

from softfinger.proxy.kernels.model.effects import *
from softfinger.proxy.kernels.model.elastic import *
from softfinger.proxy.kernels.model.laws import *
from softfinger.proxy.kernels.model.methods import *
from softfinger.proxy.kernels.model.motions import *
from softfinger.proxy.kernels.model.scene import *
from softfinger.proxy.kernels.model.shapes import *
from softfinger.proxy.kernels.model.state import *
from softfinger.proxy.kernels.model.textures import *
from softfinger.proxy.kernels.model.vectors import *
