from .files import (
    check_writable as check_writable,
    path_of as path_of,
    write_text_atomic as write_text_atomic,
)
from .result_files import (
    provenance as provenance,
    read_attributes as read_attributes,
    read_tree as read_tree,
    write_tree as write_tree,
)
