"""What pyproject.toml cannot say: the README on PyPI, where links into the repository have to be whole."""

import re
from pathlib import Path

from setuptools import setup

ROOT = Path(__file__).parent
SOURCE = re.search(r'^Source = "(.*)"$', (ROOT / "pyproject.toml").read_text(encoding="utf-8"), re.MULTILINE)
VERSION = re.search(r'^version = "(.*)"$', (ROOT / "pyproject.toml").read_text(encoding="utf-8"), re.MULTILINE)
assert SOURCE is not None
assert VERSION is not None
HERE = f"{SOURCE[1]}/blob/v{VERSION[1]}"

text = (ROOT / "README.md").read_text(encoding="utf-8")
text = re.sub(r"(!\[[^\]]*\]\()(?!https?:)([^)]+)\)", rf"\1{SOURCE[1]}/raw/v{VERSION[1]}/\2)", text)
text = re.sub(r"((?<!!)\[[^\]]*\]\()(?!https?:|#)([^)]+)\)", rf"\1{HERE}/\2)", text)

setup(long_description=text, long_description_content_type="text/markdown")
