"""Model files that are TOML: every byte chooses a key or what it holds, which reaches what lies behind the syntax."""

from fuzz import model_file

KEYS = (
    *("name", "state", "drift", "observation", "observation_kind", "diffusion", "process_noise", "observation_noise", "start"),
    *("periodic", "functions", "parameters", "prior", "kind", "mean", "cov", "weights", "means", "covs", "log_density", "a", "x"),
)
ATOMS = (
    *("0", "1", "-1", "2.5", "1e-300", "1e999", "nan", "-inf", "true", "1979-05-27", "0xfffffffffffffffff", '"x"', '"y"', '"t"'),
    *('"-a*x"', '"sin(x)"', '"x**2 + y"', '"1/0"', '"gamma(x)"', '"a"', '"1/3"', '"samples"', '"path"', '"gaussian"'),
    *('"mixture"', '"density"', '"-x**4"', '""', '"\\u0000"', '"2x"'),
)
GOOD = (
    *('state = ["x"]', 'state = ["x", "y"]', 'drift = ["-a*x"]', 'drift = ["y", "-x"]', 'observation = ["x"]'),
    *("parameters = {a = 1}", 'prior = {kind = "gaussian", mean = [0], cov = [1]}', 'functions = ["gamma"]'),
    'prior = {kind = "gaussian", mean = [0, 1], cov = [[2, 1], [1, 2]]}',
    'prior = {kind = "mixture", weights = [1, 2], means = [[0], [1]], covs = [[1], [[2]]]}',
    *('periodic = ["x"]', 'drift = ["sin(x)"]', 'observation = ["cos(x)", "sin(x)"]', 'diffusion = [["t", "1"]]'),
    *('observation_noise = [["1", "t"], ["t", "4"]]', 'process_noise = [[1, "a"], ["a", 1]]'),
)


def text_of(data: bytes) -> str:
    """The model file that these bytes choose."""
    choices = iter(data)
    lines = []
    while (choice := next(choices, None)) is not None:
        if choice < 128:
            lines.append(GOOD[choice % len(GOOD)])
        else:
            lines.append(f"{KEYS[choice % len(KEYS)]} = {_value(choices, 0)}")
    return "\n".join(lines)


def _value(choices, depth: int) -> str:
    choice = next(choices, 0)
    if choice < 128 or depth == 4:
        return ATOMS[choice % len(ATOMS)]
    count = choice // 4 % 4
    if choice % 4:
        return f"[{', '.join(_value(choices, depth + 1) for _ in range(count))}]"
    pairs = (f"{KEYS[next(choices, 0) % len(KEYS)]} = {_value(choices, depth + 1)}" for _ in range(count))
    return "{" + ", ".join(pairs) + "}"


def one_input(data: bytes) -> None:
    model_file.one_input(text_of(data).encode())
