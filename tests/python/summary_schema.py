"""Holds summaries against a JSON schema: SCHEMA FILE... Files called wrong-* must not fit it, all others must."""

import json
import sys
from pathlib import Path

import jsonschema

schema = json.loads(Path(sys.argv[1]).read_text())
jsonschema.Draft202012Validator.check_schema(schema)
validator = jsonschema.Draft202012Validator(schema)
for path in map(Path, sys.argv[2:]):
    problems = [f"{error.json_path}: {error.message}" for error in validator.iter_errors(json.loads(path.read_text()))]
    if bool(problems) != path.name.startswith("wrong-"):
        sys.exit(f"{path}: {problems or 'accepted'}")
    print(f"{path.name}: {len(problems)} problems")
