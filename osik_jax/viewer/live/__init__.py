"""Live view of a robot in the browser: a control loop in a thread, and pages that show it (extra ``viewer``)."""

from ._page import serve as serve
from ._playback import export_html as export_html
