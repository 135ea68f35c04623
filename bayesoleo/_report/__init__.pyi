from .page import (
    render_report as render_report,
    write_report as write_report,
)
from .sentences import (
    headline as headline,
)
from .terminal import (
    print_summary as print_summary,
    write_plain_report as write_plain_report,
)
