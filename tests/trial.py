"""`python tests/trial.py JSON ARGS`: `overfly ARGS` with settings `trial.*`, which no option of the command sets."""

import json
import sys

from deploy.cli import main

if __name__ == "__main__":
    trial = json.loads(sys.argv.pop(1))
    sys.exit(main(trial={f"trial.{name}": value for name, value in trial.items()}))
