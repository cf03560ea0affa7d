/* Update of all data of a tick in one call of acados' custom update hook, instead of about a hundred calls from Python.
 * data: shift (0 or 1), first state (NX), parameters of the stages 0 to N (NP each). The last five parameters of a stage
 * are the limits of the magnitudes of its soft constraints. */
#include "acados_solver_tracking.h"

#define SOFT 5

int custom_update_init_function(tracking_solver_capsule *capsule)
{
    (void)capsule;
    return 0;
}

int custom_update_terminate_function(tracking_solver_capsule *capsule)
{
    (void)capsule;
    return 0;
}

static void shift(ocp_nlp_config *config, ocp_nlp_dims *dims, ocp_nlp_out *out, const char *field, int count)
{
    double value[64];
    for (int k = 0; k < count; k++) {
        ocp_nlp_out_get(config, dims, out, k + 1, field, value);
        ocp_nlp_out_set(config, dims, out, k, field, value);
    }
}

int custom_update_function(tracking_solver_capsule *capsule, double *data, int length)
{
    ocp_nlp_config *config = tracking_acados_get_nlp_config(capsule);
    ocp_nlp_dims *dims = tracking_acados_get_nlp_dims(capsule);
    ocp_nlp_in *in = tracking_acados_get_nlp_in(capsule);
    ocp_nlp_out *out = tracking_acados_get_nlp_out(capsule);
    const int N = TRACKING_N, nx = TRACKING_NX, np = TRACKING_NP;
    if (length != 1 + nx + (N + 1) * np)
        return 1;
    double *state = data + 1, *parameters = state + nx;
    if (data[0] > 0.5) {
        shift(config, dims, out, "x", N);
        shift(config, dims, out, "u", N - 1);
    }
    ocp_nlp_constraints_model_set(config, dims, in, 0, "lbx", state);
    ocp_nlp_constraints_model_set(config, dims, in, 0, "ubx", state);
    for (int k = 0; k <= N; k++) {
        double *p = parameters + k * np, lower[SOFT];
        tracking_acados_update_params(capsule, k, p, np);
        if (TRACKING_NH == 0)
            continue;
        for (int i = 0; i < SOFT; i++)
            lower[i] = -p[np - SOFT + i];
        ocp_nlp_constraints_model_set(config, dims, in, k, "lh", lower);
        ocp_nlp_constraints_model_set(config, dims, in, k, "uh", p + np - SOFT);
    }
    return 0;
}
