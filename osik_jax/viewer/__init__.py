"""Pictures, films and live views of robots, without a display or GL library.

Not imported with the package, because it loads matplotlib.
"""

from ._animate import animate as animate
from ._figures import hero_picture as hero_picture
from .live._page import serve as serve
from .live._playback import export_html as export_html
