from .generators import band_limited_noise as band_limited_noise
from .generators import compressor_noise as compressor_noise
from .generators import tone as tone
from .recordings import Recording as Recording
from .recordings import read_recording as read_recording
from .recordings import write_wav as write_wav
from .shaping import scaled_to_power as scaled_to_power
