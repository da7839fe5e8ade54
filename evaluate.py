"""Run ``duffing-env evaluate`` without an installation: python evaluate.py --help."""

from agents.cli import run_script
from agents.commands.evaluate_command import EvaluateCommand

if __name__ == "__main__":
    run_script(EvaluateCommand.run, EvaluateCommand)
