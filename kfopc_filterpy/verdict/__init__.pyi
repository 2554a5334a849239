from .assessing import assess as assess
from .assessment import Assessment as Assessment
from .assessment import Band as Band
from .assessment import Ceilings as Ceilings
from .assessment import SoundLevels as SoundLevels
