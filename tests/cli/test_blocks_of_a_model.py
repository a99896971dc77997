"""A system that falls into blocks, from the command."""


BLOCKS = """
name = "sensors"
state = ["a", "b", "p", "v"]
drift = ["-a/3", "-b/3", "v", "-p - v"]
observation = ["sin(a)", "sin(b)", "p"]
observation_kind = "samples"

[prior]
kind = "gaussian"
mean = [0, 1, 1, 0]
cov = [1, 1, 1, 1]
"""
RECORD = "time,y1,y2,y3\n0.1,0.2,0.5,1\n0.2,-0.1,,0.9\n0.3,0.05,1,0.7\n"


def test_methods_and_analyze_say_what_auto_does_block_by_block(zakai, tmp_path):
    (tmp_path / "blocks.toml").write_text(BLOCKS)
    printed = zakai("methods", "blocks.toml").out
    assert "auto takes: blocks: 2 x limited-direct, kalman-bucy\n" in printed
    assert "a, b by limited-direct; (p, v) by kalman-bucy" in " ".join(printed.split())
    page = " ".join(zakai("analyze", "blocks.toml").out.split())
    assert "Recommended: blocks: 2 x limited-direct, kalman-bucy; the system falls into 3 independent blocks" in page


def test_a_prior_that_couples_the_blocks_is_seen(zakai, tmp_path):
    coupled = "cov = [[1, 0.5, 0, 0], [0.5, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    (tmp_path / "blocks.toml").write_text(BLOCKS.replace("cov = [1, 1, 1, 1]", coupled))
    printed = " ".join(zakai("methods", "blocks.toml").out.split())
    assert "auto takes: blocks: yau-yau, kalman-bucy" in printed
    assert "(a, b) by yau-yau; (p, v) by kalman-bucy" in printed


def test_a_system_of_blocks_is_filtered_stored_and_reported(zakai, tmp_path):
    (tmp_path / "blocks.toml").write_text(BLOCKS)
    (tmp_path / "blocks.csv").write_text(RECORD)
    answer = zakai("filter", "blocks.toml", "blocks.csv", "-o", "result.nc", "--report", "report.html")
    assert answer.code == 0 and "blocks: 2 x limited-direct, kalman-bucy: the system falls into 3" in answer.out
    report = (tmp_path / "report.html").read_text()
    assert "A method for each of 3 independent blocks (2 x limited-direct, kalman-bucy) filtered 3 observations" in report
    assert "limited-direct for a, b" in report
