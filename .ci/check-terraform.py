"""Checks that a Terraform module parses and refers only to variables, resources and modules that it defines. Arguments of providers are
not checked, as that needs the network."""

import re
import sys
from pathlib import Path

import hcl2


def names(parsed, kind):
    """Names of the blocks of a kind, without the parser's quotes."""
    return [tuple(part.strip('"') for part in labels(block)) for block in parsed.get(kind, [])]


def labels(block):
    """Labels of a block: the keys on the path to its body."""
    found = []
    while isinstance(block, dict) and len(keys := [key for key in block if not key.startswith("__")]) == 1:
        if not isinstance(block[keys[0]], dict):
            break
        found.append(keys[0])
        block = block[keys[0]]
    return found


def main(folder):
    files = sorted(Path(folder).glob("*.tf"))
    text = "\n".join(file.read_text() for file in files)
    parsed = {}
    for file in files:
        with file.open() as source:
            for kind, blocks in hcl2.load(source).items():
                parsed.setdefault(kind, []).extend(blocks)
    defined = {f"var.{name[0]}" for name in names(parsed, "variable")}
    defined |= {f"module.{name[0]}" for name in names(parsed, "module")}
    defined |= {".".join(name[:2]) for name in names(parsed, "resource")}
    code = re.sub(r"#.*", "", text)
    referred = set(re.findall(r"\b(?:var|module)\.\w+|\baws_\w+\.\w+", code))
    faults = [f"{folder}: {name} is not defined" for name in sorted(referred - defined)]
    unused = {name for name in defined if name.startswith("var.")} - referred
    faults += [f"{folder}: {name} is never used" for name in sorted(unused)]
    print("\n".join(faults) or f"{len(files)} files, {len(defined)} names, {len(referred)} referred to")
    return 1 if faults or not referred else 0


sys.exit(main(sys.argv[1]))
