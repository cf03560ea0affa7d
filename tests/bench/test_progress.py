"""Progress of long commands if stderr is no terminal."""

from diffdrive_mpc.bench import progress


def test_pipe_gets_a_line_per_period(capsys, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    with progress.ProgressBar("driving", 40, lines=True) as bar:
        for _ in range(25):
            now[0] += 1.0
            bar.advance()
        now[0] += 10.0
        bar.start_stage("drawing", 3)
    lines = ["driving: 10 of 40", "driving: 20 of 40", "drawing: 0 of 3"]
    assert capsys.readouterr().err.splitlines() == lines
