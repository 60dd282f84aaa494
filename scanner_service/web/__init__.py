"""Where the browser viewer's files lie and what a browser may load with them; serves nothing itself.

The page is `INDEX_HTML`, answered at `/`; everything it refers to is under `STATIC_DIR`, mounted at `/static`.
All its references are relative, so a reverse proxy may put it under any prefix.
"""

from pathlib import Path
from typing import Final

STATIC_DIR: Final = Path(__file__).parent / "static"
INDEX_HTML: Final = STATIC_DIR / "index.html"

# The one inline element of the page: the import map that tells three's add-ons where `three` is. Browsers take no
# import map from a file, so the policy names this one by its hash; a test compares it with the page.
IMPORT_MAP_SHA256: Final = "sha256-mHP4EkHlokG1r1jaIXvQCle8I3suYwcwIRznZoVE+zQ="

CONTENT_SECURITY_POLICY: Final = "; ".join(
    (
        "default-src 'none'",
        f"script-src 'self' '{IMPORT_MAP_SHA256}'",
        "style-src 'self'",
        "img-src 'self'",
        "connect-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
