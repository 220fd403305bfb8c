"""Live view of a robot in the browser: a control loop in a thread, and pages that show it (extra ``viewer``)."""

from ._batch import serve_batch as serve_batch
from ._export import export_html as export_html
from ._page import serve as serve
from ._reach import serve_reach as serve_reach
from ._session import Session as Session
from ._session import load_session as load_session
