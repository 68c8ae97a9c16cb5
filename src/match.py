"""`python -m src.match`: see `meshspiral.commands.match`."""

from meshspiral.commands.match import main

if __name__ == "__main__":
    main()
