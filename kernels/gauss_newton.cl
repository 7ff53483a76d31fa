// Gauss-Newton registration of band-passed image pairs: shift, magnification, gain and offset.
//
// Minimises  sum_q w(q) [A(q) - g B(c + (q - c - t)/m) - o]^2  over t, m, g, o for each view. B is
// the spline of the simulated image (lined coefficients, see bandpass.cl), A = sum_k a_k A_k the
// measured image in the mixture of blurs that resembles B most. With P, Q = dB/dx, dB/dy,
// X = (q - c - t)/m and S = (P X_u + Q X_v)/h, h half the diagonal, the linear model around the
// current t, m is  A = P x0 + Q x1 + S x2 + B g + o  with  x0 = -g dt_u/m, x1 = -g dt_v/m and
// x2 = -g h dm/m: five linear unknowns, no gain to be carried on.
//
// A round is gauss_newton_sums.cl (sums over the image), then advance (one work-item a view solves
// and moves on). Coordinates are pixels from the centre of the first; c is the detector's centre.
// `state` keeps STATE floats a view, see gauss_newton.clh.

#include "vectors.clh"
#include "gauss_newton.clh"

// Start of every view: the coarse shift or none; views without signal are done at once.
// One work-item a view. Level: the largest of the wide image on a grid of up to 16 x 16 points; a
// signal weaker than 1e-5 of it is rounding, NaN and infinity make the level NaN.
kernel required_group void start(
    global float *restrict state, // (views, STATE)
    const ulong state_offset,
    global float *restrict estimates, // (views, FIELDS)
    const ulong estimates_offset,
    global float *restrict levels, // (views, 2): of measured and simulated image
    const ulong levels_offset,
    global const float *restrict shifts, // (views, 2): (u, v), pixels
    const ulong shifts_offset,
    const int coarse, // 0: shifts are not read
    global const float *restrict wide_measured, // lined (views, coarse_rows, stride)
    const ulong wide_measured_offset,
    global const float *restrict wide_simulated, // likewise
    const ulong wide_simulated_offset,
    const int coarse_rows,
    const int columns,
    const int stride,
    const float max_shift, // pixels
    const float unknown, // sigma of a shift that is not known, pixels
    const float unknown_magnification, // sigma of a magnification that is not known
    const int views)
{
    state += state_offset;
    estimates += estimates_offset;
    levels += levels_offset;
    shifts += shifts_offset;
    const int view = get_global_id(0);
    if (view >= views)
        return;
    state += view * STATE;
    for (int k = 0; k < STATE; ++k)
        state[k] = 0.0f;
    if (coarse) {
        state[SHIFT_U] = clamp(shifts[2 * view], -max_shift, max_shift);
        state[SHIFT_V] = clamp(shifts[2 * view + 1], -max_shift, max_shift);
    }
    for (int image = 0; image < 2; ++image) {
        global const float *wide = (image ? wide_simulated + wide_simulated_offset
                                          : wide_measured + wide_measured_offset) +
                                   (ulong)view * coarse_rows * stride + MARGIN;
        const int down = (coarse_rows + 15) / 16, right = (columns + 15) / 16;
        float level = 0.0f;
        for (int j = 0; j < coarse_rows; j += down)
            for (int i = 0; i < columns; i += right) {
                const float value = fabs(wide[(ulong)j * stride + i]);
                level = value > level || isnan(value) ? value : level; // NaN gets in and stays
            }
        levels[2 * view + image] = level;
    }
    estimates += view * FIELDS;
    for (int k = 0; k < FIELDS; ++k)
        estimates[k] = k == 2 || k == 3 ? 1.0f : 0.0f; // magnification and gain
    estimates[7] = estimates[8] = unknown;
    estimates[9] = unknown_magnification;
}

// Judge where a view stands, keep it if it is the best so far, and go on: a Gauss-Newton step from
// the best, or half-way back to it. One work-item a view; estimates are those of the best.
kernel required_group void advance(
    global float *restrict state, // (views, STATE)
    const ulong state_offset,
    global float *restrict estimates, // (views, FIELDS)
    const ulong estimates_offset,
    global float *restrict sums, // (views, blocks, SUMS), the first block's are used up
    const ulong sums_offset,
    global const float *restrict levels, // (views, 2)
    const ulong levels_offset,
    const int blocks,
    const float radius, // h, pixels
    global const float *restrict noise, // (BLURS, BLURS): white noise's covariance in A_k
    const ulong noise_offset,
    const float max_shift, // pixels: beyond it the view stays with its best
    const float max_growth, // likewise for |m - 1|
    const float max_step, // largest movement of a round, pixels
    const float tolerance, // a view that moves less is done, pixels
    const float unknown, // largest sigma of a shift, pixels
    const float unknown_magnification, // largest sigma of a magnification
    const int magnification, // 0: m stays 1
    global const float *restrict known, // (views): log of the magnification known before
    const ulong known_offset,
    const float spread, // standard deviation of log(magnification) expected, 0: unknown
    const int views)
{
    state += state_offset;
    estimates += estimates_offset;
    sums += sums_offset;
    levels += levels_offset;
    noise += noise_offset;
    known += known_offset;
    const int view = get_global_id(0);
    if (view >= views)
        return;
    state += view * STATE;
    if (state[DONE] != 0.0f)
        return;
    estimates += view * FIELDS;
    sums += (ulong)view * blocks * SUMS;
    volatile global float *moments = sums;
    float mean[TERMS];
    const float weight = centre_moments(moments, blocks, mean);

    const float floor_a = 1e-5f * levels[2 * view], floor_b = 1e-5f * levels[2 * view + 1];
    float mix[BLURS];
    const float total = match(moments, mix);
    float energy = 0.0f, white = 0.0f, mean_a = 0.0f, target[4] = {0.0f, 0.0f, 0.0f, 0.0f};
    for (int k = 0; k < BLURS; ++k) {
        mean_a += mix[k] * mean[5 + k];
        for (int i = 0; i < 4; ++i)
            target[i] += mix[k] * moments[OF(i, 5 + k)];
        for (int l = 0; l < BLURS; ++l) {
            energy += mix[k] * mix[l] * moments[OF(5 + min(k, l), 5 + max(k, l))];
            white += mix[k] * mix[l] * noise[BLURS * k + l];
        }
    }
    const float correlation = target[3] * rsqrt(energy * moments[OF(3, 3)]);
    // Every comparison is false for NaN, so that whatever is not a number ends here.
    if (!(moments[OF(5, 5)] > floor_a * floor_a * weight &&
          moments[OF(3, 3)] > floor_b * floor_b * weight && isfinite(correlation))) {
        state[DONE] = 1.0f;
        return;
    }
    // White noise, filtered: `area` pixels count as one sample.
    const float area = total * total / white, samples = weight / area;
    const float m = 1.0f + state[GROWTH], grown = log(m) + known[view];
    // What the prior takes off the logarithm of the likelihood, as a change of the correlation that
    // would take off the same.
    const float unexplained = fmax(1.0f - correlation * correlation, 1e-7f);
    const float doubt = magnification && spread > 0.0f ? unexplained / (samples * spread * spread)
                                                       : 0.0f;
    const float merit = correlation *
                        exp(-0.5f * doubt * grown * grown / (correlation * correlation));
    if (!(merit > state[BEST] - 1e-6f && correlation > 0.0f)) {
        float away = 0.0f;
        for (int k = 0; k < 3; ++k) {
            const float back = 0.5f * (state[k] - state[BEST_U + k]);
            state[k] = state[BEST_U + k] + back;
            away = fmax(away, fabs(k < 2 ? back : back * radius));
        }
        state[DONE] = state[BEST] == 0.0f || away < tolerance;
        return;
    }

    // Columns scaled: gradients by their common size, so that a direction that has none stays
    // where it is (see the term added to the diagonal), B by its own.
    const float gradient = rsqrt(fmax(moments[OF(0, 0)], moments[OF(1, 1)]));
    const float scale[4] = {gradient, gradient, gradient, rsqrt(moments[OF(3, 3)])};
    float a[4][4], b[4], x[4];
    for (int i = 0; i < 4; ++i) {
        b[i] = target[i] * scale[i];
        for (int j = 0; j <= i; ++j)
            a[i][j] = moments[OF(j, i)] * scale[i] * scale[j];
        a[i][i] += i < 3 ? 1e-5f : 0.0f;
    }
    // The prior on x2 = -g h dm/m, with the gain of this round.
    const float lever = target[3] / moments[OF(3, 3)] * radius;
    const float pull = doubt * energy / (lever * lever);
    a[2][2] += pull * scale[2] * scale[2];
    b[2] += pull * lever * grown * scale[2];
    if (!magnification) {
        a[2][0] = a[2][1] = a[3][2] = b[2] = 0.0f;
        a[2][2] = 1.0f;
    }
    const int sound = factorise(a, 4);
    if (sound)
        solve(a, 4, b, x);
    if (!(sound && x[3] > 0.0f)) {
        state[DONE] = 1.0f;
        return;
    }
    float explained = 0.0f, constant_part = mean_a;
    for (int k = 0; k < 4; ++k) {
        x[k] *= scale[k];
        explained += x[k] * target[k];
        constant_part -= x[k] * mean[k];
    }
    explained += pull * x[2] * (x[2] - lever * grown);
    const float gain = x[3];
    const float toward[3] = {-m * x[0] / gain, -m * x[1] / gain, -m * x[2] / (gain * radius)};

    const float residual = fmax(energy - explained, 1e-7f * energy) / weight;
    const float variance = residual * area * samples / fmax(samples - 5.0f, 1.0f);
    float sigma[3];
    for (int k = 0; k < 3; ++k) {
        float unit[4] = {0.0f, 0.0f, 0.0f, 0.0f}, inverse[4];
        unit[k] = 1.0f;
        solve(a, 4, unit, inverse);
        sigma[k] = m / gain * scale[k] * sqrt(variance * inverse[k]);
    }
    const float movement = fmax(fmax(fabs(toward[0]), fabs(toward[1])), fabs(toward[2]) * radius);
    const float shorten = fmin(1.0f, max_step / movement);
    const int done = movement < tolerance;
    for (int k = 0; k < 3; ++k) {
        state[BEST_U + k] = state[k];
        state[k] += movement > 0.0f ? shorten * toward[k] : 0.0f;
        // The last step is too short to be judged by another round.
        estimates[k] = (k == 2 ? 1.0f : 0.0f) + (done ? state[k] : state[BEST_U + k]);
    }
    estimates[3] = gain / total;
    estimates[4] = constant_part / total;
    estimates[5] = fmin(correlation, 1.0f);
    estimates[6] = sqrt(residual) / total;
    estimates[7] = fmin(sigma[0], unknown);
    estimates[8] = fmin(sigma[1], unknown);
    estimates[9] = magnification ? fmin(sigma[2] / radius, unknown_magnification) : 0.0f;
    state[BEST] = merit;
    const int lost = fmax(fabs(state[SHIFT_U]), fabs(state[SHIFT_V])) > max_shift ||
                     fabs(state[GROWTH]) > max_growth;
    state[DONE] = done || lost;
}
