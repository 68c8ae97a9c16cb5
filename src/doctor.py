"""`python -m src.doctor`: see `meshspiral.commands.doctor`."""

from meshspiral.commands.doctor import main

if __name__ == "__main__":
    main()
