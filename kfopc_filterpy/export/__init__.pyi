from .c99 import CExport as CExport
from .c99 import export_c as export_c
