from .ratings import AmplifierRating as AmplifierRating
from .ratings import LoudspeakerRating as LoudspeakerRating
from .ratings import OutputLimits as OutputLimits
from .ratings import output_limits as output_limits
