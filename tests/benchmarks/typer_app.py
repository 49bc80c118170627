"""The smallest Typer app: what `rlctl --help` is measured against."""

import typer

app = typer.Typer()


@app.command()
def hello(name: str) -> None:
    """Greet somebody."""
    print(f"hello {name}")


if __name__ == "__main__":
    app()
