"""Choose the horizon by comparing the tracking errors of several horizons.

`sweep` runs every combination of models, paths, seeds and values of the configuration, on all cores.
"""

from diffdrive_mpc import sweep

if __name__ == "__main__":  # other processes import this file
    table = sweep(model="ssm", trajectory=["s", "square"], plant="model:ssm", horizon=[5, 10, 20, 40])

    # The table has one row per run with the statistics of `Run.metrics`; here the position RMSE by path [mm].
    errors = 1000 * table.pivot_table("position_rmse_m", "horizon", "trajectory")
    print(errors.rename_axis(columns="position RMSE [mm]").round(2).to_string())

    # Select the shortest horizon within 5 % of the best one, because the step time increases with the horizon.
    total = errors.mean(axis="columns")
    print(f"sufficient: horizon {total[total <= 1.05 * total.min()].index[0]}")
    # To plot: errors.plot(logx=True).
