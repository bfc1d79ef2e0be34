// Fused normal equations of the regressor of a six-axis arm in C++, eight rows side by side (vector
// extensions of GCC and clang), and one setpoint to first order. Written by hand as a peer.
#include <cmath>
#include <cstring>

typedef double v8 __attribute__((vector_size(64)));
typedef long long m8 __attribute__((vector_size(64)));
constexpr int n = 6;

struct Arm {
    const double *rotation, *position, *tool, *mass, *cog, *gravity, *compliance;
};

static inline void sincos_of(double x, double &s, double &c) { s = std::sin(x); c = std::cos(x); }

static inline void sincos_of(v8 x, v8 &s, v8 &c) {
    const double round = 6755399441055744.0;
    v8 turns = (x * 0.6366197723675814 + round) - round;
    v8 r = ((x - turns * 1.5707963267341256) - turns * 6.077100506303966e-11) -
           turns * 2.0222662487959506e-21;
    v8 z = r * r;
    v8 sine = r + r * z * (-1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 +
        z * (-1.98412698298579493134e-04 + z * (2.75573137070700676789e-06 +
        z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)))));
    v8 cosine = 1.0 - 0.5 * z + z * z * (4.16666666666666019037e-02 +
        z * (-1.38888888888741095749e-03 + z * (2.48015872894767294178e-05 +
        z * (-2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 +
        z * -1.13596475577881948265e-11)))));
    v8 left = turns - 4.0 * ((turns * 0.25 + round) - round);
    m8 odd = (left == 1.0) | (left == -1.0), half = (left == 2.0) | (left == -2.0);
    v8 a = odd ? cosine : sine, b = odd ? sine : cosine;
    s = (half | (left == -1.0)) ? -a : a;
    c = (half | (left == 1.0)) ? -b : b;
}

template <class V> struct Solved { V z[n][3], o[n][3], M[n][3], tcp[3]; };

template <class V> static inline void cross(const V *a, const V *b, V *out) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

template <class V>
static inline void solve(const Arm &arm, const V *q, V mass, const V *cog, const V *w, Solved<V> &t) {
    V R[3][3], B[3][3], o[3], Rs[n][3][3];
    for (int i = 0; i < 3; i++) {
        o[i] = V{} + 0.0;
        for (int j = 0; j < 3; j++) R[i][j] = V{} + (i == j ? 1.0 : 0.0);
    }
    for (int i = 0; i <= n; i++) {
        const double *p = arm.position + 3 * i, *r = arm.rotation + 9 * i;
        for (int k = 0; k < 3; k++) {
            o[k] += R[k][0] * p[0] + R[k][1] * p[1] + R[k][2] * p[2];
            for (int j = 0; j < 3; j++)
                B[k][j] = R[k][0] * r[j] + R[k][1] * r[3 + j] + R[k][2] * r[6 + j];
        }
        if (i == n) { std::memcpy(R, B, sizeof B); break; }
        V s, c;
        sincos_of(q[i], s, c);
        for (int k = 0; k < 3; k++) {
            R[k][0] = c * B[k][0] + s * B[k][1];
            R[k][1] = c * B[k][1] - s * B[k][0];
            R[k][2] = B[k][2];
            t.z[i][k] = R[k][2];
            t.o[i][k] = o[k];
        }
        std::memcpy(Rs[i], R, sizeof R);
    }
    const double *tool = arm.tool + 9, *g = arm.gravity;
    V held[3], weight[3], about[3], force[3], part[3];
    for (int k = 0; k < 3; k++) {
        t.tcp[k] = o[k] + R[k][0] * tool[0] + R[k][1] * tool[1] + R[k][2] * tool[2];
        held[k] = o[k] + R[k][0] * cog[0] + R[k][1] * cog[1] + R[k][2] * cog[2];
        weight[k] = mass * g[k];
        force[k] = w[k] + weight[k];
    }
    cross(t.tcp, w, about);
    cross(held, weight, part);
    for (int k = 0; k < 3; k++) about[k] += w[3 + k] + part[k];
    for (int i = n - 1; i >= 0; i--) {
        const double *c = arm.cog + 3 * i;
        for (int k = 0; k < 3; k++) {
            held[k] = t.o[i][k] + Rs[i][k][0] * c[0] + Rs[i][k][1] * c[1] + Rs[i][k][2] * c[2];
            weight[k] = V{} + arm.mass[i] * g[k];
            force[k] += weight[k];
        }
        cross(held, weight, part);
        for (int k = 0; k < 3; k++) about[k] += part[k];
        cross(t.o[i], force, part);
        for (int k = 0; k < 3; k++) t.M[i][k] = about[k] - part[k];
    }
}

template <class V> static inline void columns(const Solved<V> &t, V A[2 * n][3]) {
    for (int i = 0; i < n; i++) {
        V along = t.z[i][0] * t.M[i][0] + t.z[i][1] * t.M[i][1] + t.z[i][2] * t.M[i][2];
        V a[3], r[3], d[3];
        for (int k = 0; k < 3; k++) {
            a[k] = along * t.z[i][k];
            r[k] = t.M[i][k] - a[k];
            d[k] = t.tcp[k] - t.o[i][k];
        }
        cross(a, d, A[i]);
        cross(r, d, A[n + i]);
    }
}

static inline void gathered(const double *q, const double *m, const double *cog, const double *w,
                            long r, v8 *Q, v8 &M, v8 *C, v8 *W) {
    for (int k = 0; k < 8; k++) {
        for (int i = 0; i < n; i++) Q[i][k] = q[(r + k) * n + i];
        for (int i = 0; i < 3; i++) C[i][k] = cog[(r + k) * 3 + i];
        for (int i = 0; i < 6; i++) W[i][k] = w[(r + k) * 6 + i];
        M[k] = m[r + k];
    }
}

extern "C" {

// G (13, 13) grows by [A | gap]'[A | gap], lower triangle
void normal(Arm arm, const double *q, const double *m, const double *cog, const double *w,
            const double *gap, long count, double *G) {
    constexpr int K = 2 * n + 1;
    static thread_local v8 S[K][K];
    std::memset(S, 0, sizeof S);
    for (long r = 0; r < count; r += 8) {
        v8 Q[n], M, C[3], W[6], X[K][3];
        gathered(q, m, cog, w, r, Q, M, C, W);
        Solved<v8> t;
        solve(arm, Q, M, C, W, t);
        columns(t, X);
        for (int j = 0; j < 3; j++)
            for (int k = 0; k < 8; k++) X[K - 1][j][k] = gap[(r + k) * 3 + j];
        for (int a = 0; a < K; a++)
            for (int b = 0; b <= a; b++)
                S[a][b] += X[a][0] * X[b][0] + X[a][1] * X[b][1] + X[a][2] * X[b][2];
    }
    for (int a = 0; a < K; a++)
        for (int b = 0; b <= a; b++)
            for (int k = 0; k < 8; k++) G[a * K + b] += S[a][b][k];
}

// found: joint step (6), deflection (3)
void setpoint(Arm arm, const double *q, double mass, const double *cog, const double *w,
              double damping, double *found) {
    Solved<double> t;
    solve(arm, q, mass, cog, w, t);
    double A[2 * n][3], J[n][3], e[3] = {0, 0, 0}, G[3][3] = {};
    columns(t, A);
    for (int i = 0; i < n; i++) {
        const double d[3] = {t.tcp[0] - t.o[i][0], t.tcp[1] - t.o[i][1], t.tcp[2] - t.o[i][2]};
        cross(t.z[i], d, J[i]);
        for (int k = 0; k < 3; k++) {
            e[k] += arm.compliance[3 * i + 2] * A[i][k] + arm.compliance[3 * i] * A[n + i][k];
            for (int j = 0; j <= k; j++) G[k][j] += J[i][k] * J[i][j];
        }
    }
    for (int k = 0; k < 3; k++) G[k][k] += damping * damping;
    double a = std::sqrt(G[0][0]), b = G[1][0] / a, c = G[2][0] / a;
    double d = std::sqrt(G[1][1] - b * b), f = (G[2][1] - c * b) / d;
    double h = std::sqrt(G[2][2] - c * c - f * f);
    double y0 = -e[0] / a, y1 = (-e[1] - b * y0) / d, y2 = (-e[2] - c * y0 - f * y1) / h / h;
    y1 = (y1 - f * y2) / d;
    y0 = (y0 - b * y1 - c * y2) / a;
    for (int i = 0; i < n; i++) found[i] = J[i][0] * y0 + J[i][1] * y1 + J[i][2] * y2;
    for (int k = 0; k < 3; k++) found[n + k] = e[k];
}
}
