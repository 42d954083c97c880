"""The program behind `caraware study`, which says so where Optuna is not installed."""

import sys

try:
    from caraware.trials.study import main
except ModuleNotFoundError as error:
    if error.name != "optuna":
        raise
    sys.exit("error: Optuna is not installed\nhelp: pip install 'caraware[study]'; `make build` installs it, too")

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
