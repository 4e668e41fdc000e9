/* The identification filter written by hand in C: square-root unscented filter with process noise
   in the equations of motion, as bampipe/estimate/square_root.py computes it, for one model whose
   sizes are fixed at compile time. model.h is printed from the model's equations:

       static inline void derivative(const double *x, const double *u, const double *p,
                                     const double *w, double *dx)    one state
       NX states, NU inputs, NP parameters, NW process noises

   The parameter LOGARITHMIC (or none, if negative) is estimated as its logarithm; readings are the
   first NY states. The loop over sigma points is the innermost one, so that the compiler may put
   it into vector registers if it has elementary functions for them. */
#include <math.h>
#include "model.h"

#define N (NX + NP)
#define PAIRS (N + NW)
#define POINTS (1 + 2 * PAIRS)
#define EXTRA (PAIRS + NW)

static double x[NX][POINTS], probe[NX][POINTS], total[NX][POINTS], rate[NX][POINTS];
static double q[NP][POINTS], w[NW][POINTS];

static void rates(double state[NX][POINTS], const double *u)
{
    for (int r = 0; r < POINTS; r++) {
        double s[NX], p[NP], n[NW], d[NX];
        for (int i = 0; i < NX; i++) s[i] = state[i][r];
        for (int i = 0; i < NP; i++) p[i] = q[i][r];
        for (int i = 0; i < NW; i++) n[i] = w[i][r];
        derivative(s, u, p, n, d);
        for (int i = 0; i < NX; i++) rate[i][r] = d[i];
    }
}

static void runge_kutta(const double *u0, const double *u1, double dt, int steps)
{
    const double delta = dt / steps;
    double u[NU];
    for (int step = 0; step < steps; step++)
        for (int stage = 0; stage < 4; stage++) {
            double share = (step + 0.5 * ((stage + 1) / 2)) / steps;
            double ahead = stage == 2 ? delta : 0.5 * delta;
            double weight = stage == 1 || stage == 2 ? delta / 3.0 : delta / 6.0;
            for (int i = 0; i < NU; i++) u[i] = u0[i] + (u1[i] - u0[i]) * share;
            rates(stage == 0 ? x : probe, u);
            for (int i = 0; i < NX; i++)
                for (int r = 0; r < POINTS; r++) {
                    double sum = (stage == 0 ? x[i][r] : total[i][r]) + weight * rate[i][r];
                    total[i][r] = sum;
                    if (stage == 3) x[i][r] = sum;
                    else probe[i][r] = x[i][r] + ahead * rate[i][r];
                }
        }
}

/* R of R^T R + A^T A by Householder reflections; columns[j] is column j of A. */
static void append_rows(double upper[N][N], int n, double columns[N][EXTRA], int rows)
{
    for (int j = 0; j < n; j++) {
        double square = 0.0;
        for (int i = 0; i < rows; i++) square += columns[j][i] * columns[j][i];
        if (square == 0.0) continue;
        double head = upper[j][j], norm = sqrt(head * head + square);
        double sign = head < 0.0 ? 1.0 : -1.0, pivot = head - sign * norm;
        double scale = 1.0 / (norm * (norm + fabs(head)));
        upper[j][j] = norm;
        for (int k = j + 1; k < n; k++) {
            double dot = pivot * upper[j][k];
            for (int i = 0; i < rows; i++) dot += columns[j][i] * columns[k][i];
            dot *= scale;
            for (int i = 0; i < rows; i++) columns[k][i] -= dot * columns[j][i];
            upper[j][k] = sign * (upper[j][k] - dot * pivot);
        }
    }
}

/* Filter `samples` samples; mean and factor (lower root) in and out, means out. Returns 0, or the
   sample at which a number was not finite. weights: spread, weight of every point but the first. */
int filter(int samples, const double *t, const double *u, const double *y, double *mean,
           double *factor_, const double *noise_sd, const double *reading_sd,
           const double *weights, double longest_step, double *means)
{
    double (*factor)[N] = (double (*)[N])factor_;
    static double root[N][N], columns[N][EXTRA], noise[NY][NY], cross[NY][N], gain[NY][N];
    const double reach = sqrt(weights[0]), other = weights[1], half = sqrt(0.5 * other);
    for (int i = 0; i < N; i++) means[i] = mean[i];
    for (int k = 1; k < samples; k++) {
        double dt = t[k] - t[k - 1];
        int steps = (int)ceil(dt / longest_step - 1e-6);
        if (steps < 1) steps = 1;
        for (int i = 0; i < N; i++) {
            double *at = i < NX ? x[i] : q[i - NX];
            for (int r = 0; r < POINTS; r++) at[r] = mean[i];
            for (int j = 0; j <= i; j++) {
                at[j] += reach * factor[i][j];
                at[PAIRS + j] -= reach * factor[i][j];
            }
            if (i - NX == LOGARITHMIC)
                for (int r = 0; r < POINTS; r++) at[r] = exp(at[r]);
        }
        for (int i = 0; i < NW; i++) {
            for (int r = 0; r < POINTS; r++) w[i][r] = 0.0;
            w[i][N + i] = reach * noise_sd[i];
            w[i][PAIRS + N + i] = -reach * noise_sd[i];
        }
        runge_kutta(u + (k - 1) * NU, u + k * NU, dt, steps);
        for (int i = 0; i < NX; i++) {
            double middle = x[i][2 * PAIRS], sum = 0.0;
            for (int r = 0; r < 2 * PAIRS; r++) sum += x[i][r] - middle;
            mean[i] = middle + other * sum;
            if (!isfinite(mean[i])) return k;
            for (int j = 0; j < PAIRS; j++)
                columns[i][j] = half * (x[i][j] + x[i][PAIRS + j] - 2.0 * mean[i]);
            for (int j = 0; j < NW; j++)
                columns[i][PAIRS + j] = half * (x[i][N + j] - x[i][PAIRS + N + j]);
        }
        for (int i = 0; i < N; i++)
            for (int j = 0; j < N; j++) root[i][j] = 0.0;
        append_rows(root, NX, columns, EXTRA);
        for (int i = 0; i < N; i++)
            for (int j = 0; j < N; j++)
                columns[i][j] = i < NX ? half * (x[i][j] - x[i][PAIRS + j])
                                       : (j <= i ? factor[i][j] : 0.0);
        append_rows(root, N, columns, N);
        for (int i = 0; i < NY; i++) {
            for (int j = 0; j < N; j++) cross[i][j] = j <= i ? root[j][i] : 0.0;
            for (int j = 0; j < NY; j++) noise[i][j] = i == j ? reading_sd[i] : 0.0;
        }
        double whitened[NY];
        for (int i = 0; i < NY; i++) {
            double root_sum[N + 1];
            root_sum[N] = noise[i][i] * noise[i][i];
            for (int j = N - 1; j >= 0; j--)
                root_sum[j] = root_sum[j + 1] + cross[i][j] * cross[i][j];
            for (int j = 0; j <= N; j++) root_sum[j] = sqrt(root_sum[j]);
            noise[i][i] = root_sum[0];
            for (int j = 0; j < N; j++) gain[i][j] = 0.0;
            for (int j = N - 1; j >= 0; j--) {
                double c = root_sum[j + 1] / root_sum[j], s = cross[i][j] / root_sum[j];
                if (s == 0.0) continue;
                for (int m = j; m < N; m++) {
                    double old = root[j][m];
                    root[j][m] = c * old - s * gain[i][m];
                    gain[i][m] = s * old + c * gain[i][m];
                }
                for (int m = i + 1; m < NY; m++) {
                    double old = cross[m][j];
                    cross[m][j] = c * old - s * noise[m][i];
                    noise[m][i] = s * old + c * noise[m][i];
                }
            }
        }
        for (int i = 0; i < NY; i++) whitened[i] = y[k * NY + i] - mean[i];
        for (int i = 0; i < NY; i++) {
            for (int j = 0; j < i; j++) whitened[i] -= noise[i][j] * whitened[j];
            whitened[i] /= noise[i][i];
        }
        for (int i = 0; i < NY; i++)
            for (int j = 0; j < N; j++) mean[j] += gain[i][j] * whitened[i];
        for (int i = 0; i < N; i++)
            for (int j = 0; j < N; j++) factor[i][j] = j <= i ? root[j][i] : 0.0;
        for (int i = 0; i < N; i++) means[k * N + i] = mean[i];
    }
    return 0;
}
