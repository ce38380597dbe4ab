// The depth filter of the slambook, section 12.3, written as the book writes its loop: double precision, one patch
// correlation at a time, one pixel after the other. Inverse depth, the direct product of two Gaussians, and the shifted
// ray in the reference frame, so that it asks for the same matches as vislam's filter.
//
//   depth_filter IN OUT
//
// IN: int32 width, height, frames; double fx, fy, cx, cy, rho_min, rho_max, sigmas, step, reach, least, sigma_px,
// converged; per frame 12 doubles R_cur_ref (row major), t_cur_ref; then width*height bytes per image, reference first.
// OUT: per frame double CPU ms, then float rho, float variance [h, w].
// -DARRAYS keeps patches in arrays on the stack instead of the book's vectors.
#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <vector>

using namespace std;

static const int half_size = 3, border = 6;
static const int area = (2 * half_size + 1) * (2 * half_size + 1);
static int width, height;
static double fx, fy, cx, cy, rho_min, rho_max, sigmas, step, reach, least, sigma_px, converged;

typedef vector<uint8_t> Image;

static double bilinear(const Image& image, double u, double v) {
    const uint8_t* d = &image[int(v) * width + int(u)];
    double xx = u - floor(u), yy = v - floor(v);
    return ((1 - xx) * (1 - yy) * double(d[0]) + xx * (1 - yy) * double(d[1]) + (1 - xx) * yy * double(d[width]) +
            xx * yy * double(d[width + 1])) / 255.0;
}

static double zncc(const Image& ref, const Image& cur, int x, int y, double u, double v) {
    double mean_ref = 0, mean_cur = 0;
#ifdef ARRAYS
    array<double, area> values_ref, values_cur;
    int n = 0;
#else
    vector<double> values_ref, values_cur;
#endif
    for (int i = -half_size; i <= half_size; i++)
        for (int j = -half_size; j <= half_size; j++) {
            double value_ref = double(ref[(j + y) * width + i + x]) / 255.0;
            double value_cur = bilinear(cur, u + i, v + j);
            mean_ref += value_ref;
            mean_cur += value_cur;
#ifdef ARRAYS
            values_ref[n] = value_ref;
            values_cur[n++] = value_cur;
#else
            values_ref.push_back(value_ref);
            values_cur.push_back(value_cur);
#endif
        }
    mean_ref /= area;
    mean_cur /= area;
    double numerator = 0, squares_ref = 0, squares_cur = 0;
    for (int i = 0; i < area; i++) {
        numerator += (values_ref[i] - mean_ref) * (values_cur[i] - mean_cur);
        squares_ref += (values_ref[i] - mean_ref) * (values_ref[i] - mean_ref);
        squares_cur += (values_cur[i] - mean_cur) * (values_cur[i] - mean_cur);
    }
    return numerator / sqrt(squares_ref * squares_cur + 1e-10);
}

static double triangulate(const double* q, const double* t, double u, double v, double du, double dv) {
    return (du * (u * q[2] - q[0]) + dv * (v * q[2] - q[1])) / (du * (t[0] - u * t[2]) + dv * (t[1] - v * t[2]));
}

static void update(const Image& ref, const Image& cur, const double* R, const double* t, vector<float>& rho,
                   vector<float>& variance) {
    for (int y = border; y < height - border; y++)
        for (int x = border; x < width - border; x++) {
            float &mu = rho[y * width + x], &var = variance[y * width + x];
            if (var < converged * converged * mu * mu) continue;
            double sigma = sqrt(var), h = (x - cx) / fx, k = (y - cy) / fy;
            double q[3];
            for (int i = 0; i < 3; i++) q[i] = R[3 * i] * h + R[3 * i + 1] * k + R[3 * i + 2];
            double rhos[3] = {fmax(mu - sigmas * sigma, rho_min), mu, fmin(mu + sigmas * sigma, rho_max)};
            double px[3], py[3];
            for (int i = 0; i < 3; i++) {
                double z = q[2] + t[2] * rhos[i];
                px[i] = fx * (q[0] + t[0] * rhos[i]) / z + cx;
                py[i] = fy * (q[1] + t[1] * rhos[i]) / z + cy;
            }
            double length = hypot(px[2] - px[0], py[2] - py[0]);
            if (!(length > 1e-9)) continue;
            double eu = (px[2] - px[0]) / length, ev = (py[2] - py[0]) / length;
            double begin = fmax((px[0] - px[1]) * eu + (py[0] - py[1]) * ev, -reach) - step;
            double end = fmin((px[2] - px[1]) * eu + (py[2] - py[1]) * ev, reach) + step;
            int count = int((end - begin) / step) + 1, best = -1;
            vector<double> scores(count, -INFINITY);
            for (int i = 0; i < count; i++) {
                double u = px[1] + (begin + i * step) * eu, v = py[1] + (begin + i * step) * ev;
                if (!(u >= border && v >= border && u < width - border && v < height - border)) continue;
                scores[i] = zncc(ref, cur, x, y, u, v);
                if (best < 0 || scores[i] > scores[best]) best = i;
            }
            if (best <= 0 || best == count - 1 || scores[best] < least) continue;
            double before = scores[best - 1], after = scores[best + 1];
            if (!isfinite(before) || !isfinite(after)) continue;
            double bend = before - 2 * scores[best] + after;
            double along = begin + (best + (bend < 0 ? 0.5 * (before - after) / bend : 0)) * step;
            double u = (px[1] + along * eu - cx) / fx, v = (py[1] + along * ev - cy) / fy, du = eu / fx, dv = ev / fy;
            double measured = triangulate(q, t, u, v, du, dv);
            double off = triangulate(q, t, u + sigma_px * du, v + sigma_px * dv, du, dv) - measured;
            if (!(measured > 0 && isfinite(off))) continue;
            double v2 = off * off, v1 = var;
            mu = (v2 * mu + v1 * measured) / (v1 + v2);
            var = v1 * v2 / (v1 + v2);
        }
}

template <typename T>
static void take(FILE* file, T* values, size_t count) {
    if (fread(values, sizeof(T), count, file) != count) exit(1);
}

int main(int argc, char** argv) {
    if (argc != 3) return 2;
    FILE* in = fopen(argv[1], "rb");
    FILE* out = fopen(argv[2], "wb");
    if (!in || !out) return 1;
    int32_t sizes[3];
    take(in, sizes, 3);
    width = sizes[0], height = sizes[1];
    double* settings[] = {&fx, &fy, &cx, &cy, &rho_min, &rho_max, &sigmas, &step, &reach, &least, &sigma_px, &converged};
    for (double* one : settings) take(in, one, 1);
    vector<array<double, 12>> motions(sizes[2]);
    for (auto& one : motions) take(in, one.data(), 12);
    Image ref(width * height), cur(width * height);
    take(in, ref.data(), ref.size());
    float sigma0 = 0.5 * (rho_max - rho_min) / sigmas;
    vector<float> rho(width * height, 0.5 * (rho_min + rho_max)), variance(width * height, sigma0 * sigma0);
    for (auto& one : motions) {
        take(in, cur.data(), cur.size());
        clock_t start = clock();
        update(ref, cur, one.data(), one.data() + 9, rho, variance);
        double ms = 1e3 * double(clock() - start) / CLOCKS_PER_SEC;
        fwrite(&ms, sizeof ms, 1, out);
    }
    fwrite(rho.data(), sizeof(float), rho.size(), out);
    fwrite(variance.data(), sizeof(float), variance.size(), out);
    return fclose(out) == 0 ? 0 : 1;
}
