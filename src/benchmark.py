"""`python -m src.benchmark`: see `meshspiral.commands.benchmark`."""

from meshspiral.commands.benchmark import main

if __name__ == "__main__":
    main()
