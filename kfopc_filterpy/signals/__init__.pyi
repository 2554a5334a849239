from .datasets import (
    DataUnavailableError as DataUnavailableError,
)
from .datasets import (
    MeasuredDuct as MeasuredDuct,
)
from .datasets import (
    load_measured_duct as load_measured_duct,
)
from .generators import (
    band_limited_noise as band_limited_noise,
)
from .generators import (
    compressor_noise as compressor_noise,
)
from .generators import (
    level_jump as level_jump,
)
from .generators import (
    scaled_to_power as scaled_to_power,
)
from .generators import (
    tone as tone,
)
from .recordings import read_mat_vector as read_mat_vector
from .recordings import read_wav as read_wav
from .recordings import write_wav as write_wav
from .varying import bursty_noise as bursty_noise
from .varying import looped as looped
from .varying import swelling as swelling
