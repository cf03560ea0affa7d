"""Choose the horizon: drive with several, and compare tracking errors in a table.

`sweep` runs every combination of models, paths, seeds and values of the configuration, on all cores.
"""

from diffdrive_mpc import sweep

if __name__ == "__main__":  # other processes import this file
    table = sweep(model="ssm", trajectory=["s", "square"], plant="model:ssm", horizon=[5, 10, 20, 40])

    # One row a run, with the statistics of `Run.metrics`; here one of them, for each path [mm].
    errors = 1000 * table.pivot_table("position_rmse_m", "horizon", "trajectory")
    print(errors.round(2).to_string())

    # The shortest horizon within 5 % of the best one: longer ones cost time at each step.
    total = errors.mean(axis="columns")
    print(f"enough: horizon {total[total <= 1.05 * total.min()].index[0]}")
    # To plot: errors.plot(logx=True).
