"""`python -m src.report`: see `meshspiral.commands.report`."""

from meshspiral.commands.report import main

if __name__ == "__main__":
    main()
