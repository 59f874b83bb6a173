"""Schema of scenes and rigs: structs with the unit in each field name.

The field of an absent table is `None`; that part (rolling, friction, torsion) is not modelled, and the contact step is
compiled without it. Values are in SI units. Structs created in code are not range-checked; `load.build` checks them,
with the ranges given here and in `limits`.

A struct may have `faults()` for conditions between several of its fields. `load.build` calls it even if some fields are
unusable; these are `UNSET`, which `is_usable` detects.
"""

from softfinger.config.fields import *
from softfinger.config.schema.addresses import *
from softfinger.config.schema.contact import *
from softfinger.config.schema.effects import *
from softfinger.config.schema.faults import *
from softfinger.config.schema.guard import *
from softfinger.config.schema.materials import *
from softfinger.config.schema.object_parts import *
from softfinger.config.schema.rig import *
from softfinger.config.schema.scene import *
from softfinger.config.schema.shapes import *
from softfinger.config.schema.world import *
