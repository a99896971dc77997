"""The commands and their arguments; the module of a command is imported when it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import zakai

app = typer.Typer(
    name="zakai",
    help="The conditional density of the state of a continuous-time stochastic system, given noisy observations.",
    epilog="To begin: zakai simulate gallery:benes --until 8 --step 0.1 -o record.csv, then zakai filter gallery:benes "
    "record.csv -o result.nc. zakai gallery lists the models, zakai methods MODEL the methods that hold, with their reasons.",
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

_Model = Annotated[str, typer.Argument(metavar="MODEL", help="A model file (TOML), or gallery:NAME.")]
_Record = Annotated[Path, typer.Argument(metavar="RECORD", help="The observations (CSV).")]
_Method = Annotated[str, typer.Option(metavar="NAME", help="A method, or auto: the first that holds.")]
_Options = Annotated[
    list[str] | None, typer.Option("--option", metavar="KEY=VALUE", help="An option of the method; repeatable.")
]
_Truth = Annotated[Path | None, typer.Option(metavar="TRUTH.csv", help="The true states, for the report.")]
_Report = Annotated[Path | None, typer.Option(metavar="REPORT.html", help="Write a report with pictures.")]
_Inputs = Annotated[Path | None, typer.Option("--inputs", metavar="FILE.csv", help="The known inputs: time, a column for each.")]
_Origin = Annotated[str | None, typer.Option(metavar="DATE", help="The date at which t = 0; by default the first one.")]
_Columns = Annotated[str, typer.Option(metavar="a,b", help="The columns of the record, in the order of the observations.")]
_Unit = Annotated[str | None, typer.Option(metavar="UNIT", help="The unit of time, for a record with dates: s, min, h, d.")]
_Output = Annotated[Path, typer.Option("-o", "--output", metavar="RESULT.nc", help="Where the result goes: NetCDF, or CSV.")]


def _show_version(asked: bool) -> None:
    if asked:
        print(f"zakai {zakai.__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")] = False,
) -> None:
    if context.invoked_subcommand is None:
        print(context.get_help())


@app.command()
def analyze(
    model: _Model,
    json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
    latex: Annotated[bool, typer.Option("--latex", help="As LaTeX.")] = False,
) -> None:
    """Decide from the equations alone which methods hold for a system, and why."""
    from zakai.cli import inspecting

    inspecting.analyze(model, json, latex)


@app.command()
def simulate(
    model: _Model,
    until: Annotated[float, typer.Option(metavar="T", help="Simulate up to this time.")],
    step: Annotated[float, typer.Option(metavar="DT", help="One observation every DT, the first at the start + DT.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="RECORD.csv", help="Where the record goes.")],
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="The same seed gives the same record.")] = 0,
    truth: Annotated[Path | None, typer.Option(metavar="TRUTH.csv", help="Where the true states go.")] = None,
    initial: Annotated[str, typer.Option(metavar="NUMBERS", help='The state at the start, as "0.1" or "0.1, 2".')] = "",
    inputs: _Inputs = None,
) -> None:
    """Simulate a path of the state and a record of its observations."""
    from zakai.cli import simulating

    simulating.simulate(model, until, step, seed, output, truth, initial, inputs)


@app.command()
def filter(
    model: _Model,
    record: _Record,
    output: _Output,
    method: _Method = "auto",
    option: _Options = None,
    truth: _Truth = None,
    report: _Report = None,
    inputs: _Inputs = None,
    unit: _Unit = None,
    origin: _Origin = None,
    columns: _Columns = "",
) -> None:
    """Compute the conditional density of the state at every time of a record."""
    from zakai.cli import filtering

    filtering.filter(
        model, record, output, method, option or [], truth, report, inputs, unit=unit, origin=origin, columns=columns
    )


@app.command()
def smooth(
    model: _Model,
    record: _Record,
    output: _Output,
    method: _Method = "auto",
    option: _Options = None,
    truth: _Truth = None,
    report: _Report = None,
    inputs: _Inputs = None,
    unit: _Unit = None,
    origin: _Origin = None,
    columns: _Columns = "",
) -> None:
    """Compute the conditional density of the state given all observations, at every time of the record."""
    from zakai.cli import filtering

    settings = option or []
    filtering.filter(
        model, record, output, method, settings, truth, report, inputs, True, unit=unit, origin=origin, columns=columns
    )


@app.command()
def forecast(
    model: _Model,
    record: _Record,
    until: Annotated[str, typer.Option(metavar="T", help="Forecast up to this time, or date of a record with dates.")],
    step: Annotated[float, typer.Option(metavar="DT", help="One forecast every DT after the end of the record, in its unit.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FORECAST.nc", help="Where the result goes (NetCDF).")],
    method: _Method = "auto",
    option: _Options = None,
    inputs: _Inputs = None,
    unit: _Unit = None,
    origin: _Origin = None,
    columns: _Columns = "",
) -> None:
    """Compute the density of the state at times after a record."""
    from zakai.cli import filtering

    filtering.forecast(model, record, until, step, output, method, option or [], inputs, unit, origin, columns=columns)


@app.command()
def fit(
    model: _Model,
    record: _Record,
    parameters: Annotated[str, typer.Option(metavar="a,b", help="The parameters to estimate; by default all.")] = "",
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FITTED.toml", help="Where the model with the estimates goes.")
    ] = None,
    method: _Method = "auto",
    option: _Options = None,
    inputs: _Inputs = None,
    unit: _Unit = None,
    origin: _Origin = None,
    columns: _Columns = "",
) -> None:
    """Estimate parameters of a model by maximum likelihood, with their standard errors."""
    from zakai.cli import filtering

    filtering.fit(model, record, parameters, output, method, option or [], inputs, unit, origin, columns=columns)


@app.command()
def stream(
    model: _Model,
    method: _Method = "auto",
    option: _Options = None,
    checkpoint: Annotated[Path | None, typer.Option(metavar="FILE", help="Save the state there, and continue from it.")] = None,
    checkpoint_every: Annotated[int | None, typer.Option(metavar="N", min=1, help="Save after every N observations.")] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Stop at the first line that cannot be used.")] = False,
    every: Annotated[int, typer.Option(metavar="N", min=1, help="Print every Nth estimate.")] = 1,
    fields: Annotated[str, typer.Option(metavar="a,b", help="What to print: time, mean, cov, interval, ...")] = "",
    unit: _Unit = None,
    origin: Annotated[str | None, typer.Option(metavar="DATE", help="The date at which t = 0, with --unit.")] = None,
) -> None:
    """Filter observations as they arrive: JSON lines or CSV on standard input, one line of JSON out for each."""
    from zakai.cli import streaming

    streaming.stream(model, method, option or [], checkpoint, checkpoint_every, strict, every, fields, unit, origin)


@app.command()
def methods(
    model: Annotated[str | None, typer.Argument(metavar="MODEL", help="Print which hold for this model.")] = None,
    record: Annotated[Path | None, typer.Argument(metavar="RECORD", help="Add how long those take for this record.")] = None,
    inputs: _Inputs = None,
    unit: _Unit = None,
    origin: _Origin = None,
    columns: _Columns = "",
) -> None:
    """List the methods; for a model, print whether each holds; for a record, how long those take that hold."""
    from zakai.cli import inspecting

    given = None if record is None else inspecting.RecordFile(record, inputs, unit, origin, columns)
    inspecting.methods(model, given)


@app.command("warm-up")
def warm_up() -> None:
    """Compile what the methods need, once for this machine, and print where it is kept."""
    from zakai.cli import inspecting

    inspecting.warm_up()


@app.command()
def gallery(
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="Print the file of this model.")] = None,
) -> None:
    """List the models that come with zakai, or print one of them."""
    from zakai.cli import inspecting

    inspecting.gallery(name)


@app.command()
def studio(
    model: Annotated[str | None, typer.Argument(metavar="MODEL", help="A model file (TOML), or gallery:NAME.")] = None,
    record: Annotated[str | None, typer.Argument(metavar="RECORD", help="The observations (CSV); - is standard input.")] = None,
    port: Annotated[int, typer.Option(metavar="N", min=0, max=65535, help="The port; by default a free one.")] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Print the address, and open no browser.")] = False,
    memory: Annotated[float, typer.Option(metavar="GIB", min=2.0, help="The most memory that a computation may take.")] = 4.0,
) -> None:
    """Open a local page on which a model is written, a record is filtered, and the density is shown."""
    from zakai.cli import showing

    showing.studio(model, record, port, not no_browser, memory)


@app.command()
def study(
    file: Annotated[Path, typer.Argument(metavar="STUDY.toml", help="Which models, methods and seeds.")],
    folder: Annotated[Path, typer.Option("-o", "--output", metavar="FOLDER", help="The results, or a study to continue.")],
    scheduler: Annotated[str | None, typer.Option(metavar="ADDRESS", help="Run it on the workers of a Dask scheduler.")] = None,
    processes: Annotated[int | None, typer.Option(metavar="N", help="Run it in N processes.")] = None,
    inputs: _Inputs = None,
) -> None:
    """Filter many records by many methods; an interrupted study continues where it stopped."""
    from zakai.cli import studying

    studying.study(file, folder, scheduler, processes, inputs)


@app.command()
def reproduce(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A published experiment; without a name all are listed.")] = "",
    folder: Annotated[Path | None, typer.Option("-o", "--output", metavar="FOLDER", help="Where pictures and tables go.")] = None,
    option: Annotated[
        list[str] | None, typer.Option(metavar="KEY=VALUE", help="An option of the study, such as paths=5; repeatable.")
    ] = None,
) -> None:
    """Run a published experiment again, and print the published figures beside the new ones."""
    from zakai.cli import studying

    studying.reproduce(name, folder, option or [])
