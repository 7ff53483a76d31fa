// Coarser and finer grids, factor 2.
//
// Restriction: the mean of 2 x 2 (x 2) elements; the last of an odd number is dropped.
// Prolongation: fine element i lies at (i - 1/2) / 2 in units of coarse elements, so that along
// each axis it is 3/4 of the coarse element that holds it and 1/4 of that one's nearer neighbour.
// Beyond the border the outermost element is repeated.
//
// All arrays are C-ordered with the columns last. A work-item makes LANES coarse columns of one
// coarse row (restriction), or the 2 LANES fine columns that they cover of one fine row
// (prolongation). Global sizes are (blocks of LANES coarse columns, rows, planes) of the output,
// rounded up at will.

#include "vectors.clh"

// p[0] + p[1], p[2] + p[3], ...
static inline real pair_sums(global const float *p)
{
    const real a = load_global(p), b = load_global(p + LANES);
    return (real)(a.even + a.odd, b.even + b.odd);
}

kernel required_group void restrict_2d(
    global float *restrict coarse, // (planes, rows, columns)
    const ulong coarse_offset,
    global const float *restrict fine, // (planes, fine_rows, fine_columns)
    const ulong fine_offset,
    const int planes,
    const int rows, // fine_rows / 2
    const int columns, // fine_columns / 2
    const int fine_rows,
    const int fine_columns)
{
    coarse += coarse_offset;
    fine += fine_offset;
    const int i = get_global_id(0) * LANES, j = get_global_id(1), k = get_global_id(2);
    if (i >= columns || j >= rows || k >= planes)
        return;
    coarse += ((ulong)k * rows + j) * columns + i;
    fine += ((ulong)k * fine_rows + 2 * j) * fine_columns + 2 * i;
    global const float *next = fine + fine_columns;
    if (i + LANES <= columns) {
        store_global(0.25f * (pair_sums(fine) + pair_sums(next)), coarse);
        return;
    }
    for (int c = 0; c < columns - i; ++c)
        coarse[c] = 0.25f * (fine[2 * c] + fine[2 * c + 1] + (next[2 * c] + next[2 * c + 1]));
}

kernel required_group void restrict_3d(
    global float *restrict coarse, // (planes, rows, columns)
    const ulong coarse_offset,
    global const float *restrict fine, // (2 planes or one more, fine_rows, fine_columns)
    const ulong fine_offset,
    const int planes,
    const int rows, // fine_rows / 2
    const int columns, // fine_columns / 2
    const int fine_rows,
    const int fine_columns)
{
    coarse += coarse_offset;
    fine += fine_offset;
    const int i = get_global_id(0) * LANES, j = get_global_id(1), k = get_global_id(2);
    if (i >= columns || j >= rows || k >= planes)
        return;
    coarse += ((ulong)k * rows + j) * columns + i;
    fine += (2 * (ulong)k * fine_rows + 2 * j) * fine_columns + 2 * i;
    global const float *right = fine + fine_columns;
    global const float *below = fine + (ulong)fine_rows * fine_columns;
    global const float *both = below + fine_columns;
    if (i + LANES <= columns) {
        const real sum =
            pair_sums(fine) + pair_sums(right) + (pair_sums(below) + pair_sums(both));
        store_global(0.125f * sum, coarse);
        return;
    }
// A few columns at the end: made vectors of, they would take a GPU's registers.
#pragma clang loop vectorize(disable) unroll(disable)
    for (int c = 0; c < columns - i; ++c) {
        const int a = 2 * c, b = 2 * c + 1;
        coarse[c] = 0.125f * (fine[a] + fine[b] + (right[a] + right[b])
                              + (below[a] + below[b] + (both[a] + both[b])));
    }
}

// Of a fine element along one axis: its nearer neighbour's coarse index; its own is i / 2.
static inline int neighbour(const int i, const int size)
{
    return clamp(i / 2 + ((i & 1) ? 1 : -1), 0, size - 1);
}

// LANES coarse columns at p of the row that lies between the four given ones
static inline real mixed(
    global const float *near,
    global const float *near_row,
    global const float *near_plane,
    global const float *far,
    const int at)
{
    return 0.5625f * load_global(near + at)
           + 0.1875f * (load_global(near_row + at) + load_global(near_plane + at))
           + 0.0625f * load_global(far + at);
}

kernel required_group void prolong_3d(
    global float *restrict fine, // (fine_planes, fine_rows, fine_columns)
    const ulong fine_offset,
    global const float *restrict coarse, // (planes, rows, columns), halves rounded down
    const ulong coarse_offset,
    const int fine_planes,
    const int fine_rows,
    const int fine_columns,
    const int planes,
    const int rows,
    const int columns)
{
    fine += fine_offset;
    coarse += coarse_offset;
    const int i = get_global_id(0) * LANES, j = get_global_id(1), k = get_global_id(2);
    if (2 * i >= fine_columns || j >= fine_rows || k >= fine_planes)
        return;
    fine += ((ulong)k * fine_rows + j) * fine_columns + 2 * i;
    const int j0 = min(j / 2, rows - 1), j1 = neighbour(j, rows);
    global const float *plane0 = coarse + (ulong)min(k / 2, planes - 1) * rows * columns;
    global const float *plane1 = coarse + (ulong)neighbour(k, planes) * rows * columns;
    global const float *a = plane0 + (ulong)j0 * columns, *b = plane0 + (ulong)j1 * columns;
    global const float *c = plane1 + (ulong)j0 * columns, *d = plane1 + (ulong)j1 * columns;
    if (i > 0 && i + LANES < columns) {
        const real own = 0.75f * mixed(a, b, c, d, i);
        const real even = own + 0.25f * mixed(a, b, c, d, i - 1);
        const real odd = own + 0.25f * mixed(a, b, c, d, i + 1);
        real low, high;
        low.even = even.lo;
        low.odd = odd.lo;
        high.even = even.hi;
        high.odd = odd.hi;
        store_global(low, fine);
        store_global(high, fine + LANES);
        return;
    }
    const int last = min(fine_columns - 2 * i, 2 * LANES);
    for (int x = 0; x < last; ++x) {
        const int i0 = min(i + x / 2, columns - 1), i1 = neighbour(2 * i + x, columns);
        const float own = 0.5625f * a[i0] + 0.1875f * (b[i0] + c[i0]) + 0.0625f * d[i0];
        const float other = 0.5625f * a[i1] + 0.1875f * (b[i1] + c[i1]) + 0.0625f * d[i1];
        fine[x] = 0.75f * own + 0.25f * other;
    }
}
