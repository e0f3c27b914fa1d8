from .atoms import read_atoms as read_atoms
from .atoms import to_xyz as to_xyz
from .tables import export as export
from .tables import original_layout as original_layout
from .tables import table as table
