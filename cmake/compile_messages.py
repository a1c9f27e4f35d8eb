"""Compiles the translations of messages for gettext: python compile_messages.py FOLDER FILE.mo

FOLDER has a .po file for each package. CMake calls this script in each build.
"""

import sys
from pathlib import Path

from babel.messages.catalog import Catalog
from babel.messages.mofile import write_mo
from babel.messages.pofile import read_po

folder, compiled = map(Path, sys.argv[1:])
catalogue = Catalog(locale=folder.name)
for file in sorted(folder.glob("*.po")):
    with file.open("rb") as source:
        for message in read_po(source, locale=folder.name, abort_invalid=True):
            if message.id and message.string and not message.fuzzy:
                catalogue[message.id] = message
compiled.parent.mkdir(parents=True, exist_ok=True)
with compiled.open("wb") as target:
    write_mo(target, catalogue)
