from .c99 import CExport as CExport
from .c99 import export_c as export_c
from .fmu import export_fmu as export_fmu
from .single import Float32Controller as Float32Controller
