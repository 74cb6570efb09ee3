"""View: recordings and live views in Rerun."""

import os

# Before the import of Rerun: what goes wrong is said by this program, in a sentence.
os.environ.setdefault("RUST_LOG", "off")
