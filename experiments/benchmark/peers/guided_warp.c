/* G-buffer guided warp (ExtraSS eq 1-3) in plain C: exact float costs, ties to the earlier candidate, OpenMP over rows.
   Images are [height][width][channels]; motion in pixels (x, y), previous = current + motion. */
#include <math.h>

enum { CANDIDATES = 33, WINNERS = 4, MOST_GUIDES = 16 };

void guided_warp(const float *radiance, const float *guide_previous, const float *guide, const float *motion,
                 const int *offsets, const float *inverse_variance, float *out, int height, int width, int channels,
                 int guides) {
#pragma omp parallel for schedule(dynamic, 8)
  for (int row = 0; row < height; row++)
    for (int column = 0; column < width; column++) {
      const long pixel = (long)row * width + column;
      const float x = column + 0.5f + motion[2 * pixel], y = row + 0.5f + motion[2 * pixel + 1];
      const int center_x = (int)floorf(x), center_y = (int)floorf(y);
      float here[MOST_GUIDES], cost[WINNERS + 1];
      long winner[WINNERS + 1];
      int found = 0;
      for (int g = 0; g < guides; g++) here[g] = guide[pixel * guides + g];
      for (int c = 0; c < CANDIDATES; c++) {
        const int cx = center_x + offsets[2 * c], cy = center_y + offsets[2 * c + 1];
        if (cx < 0 || cx >= width || cy < 0 || cy >= height) continue;
        const long other = (long)cy * width + cx;
        const float dx = x - cx - 0.5f, dy = y - cy - 0.5f;
        float total = inverse_variance[guides] * (dx * dx + dy * dy);
        for (int g = 0; g < guides; g++) {
          const float d = here[g] - guide_previous[other * guides + g];
          total += inverse_variance[g] * d * d;
        }
        if (found == WINNERS && total >= cost[WINNERS - 1]) continue;
        int place = found < WINNERS ? found++ : WINNERS - 1;
        while (place > 0 && cost[place - 1] > total) {
          cost[place] = cost[place - 1];
          winner[place] = winner[place - 1];
          place--;
        }
        cost[place] = total;
        winner[place] = other;
      }
      if (!found) {
        const int cx = center_x < 0 ? 0 : center_x >= width ? width - 1 : center_x;
        const int cy = center_y < 0 ? 0 : center_y >= height ? height - 1 : center_y;
        winner[0] = (long)cy * width + cx;
        cost[0] = 0.0f;
        found = 1;
      }
      float weight[WINNERS], sum = 0.0f;
      for (int k = 0; k < found; k++) sum += weight[k] = expf(0.5f * (cost[0] - cost[k]));
      for (int c = 0; c < channels; c++) {
        float value = 0.0f;
        for (int k = 0; k < found; k++) value += weight[k] * radiance[winner[k] * channels + c];
        out[pixel * channels + c] = value / sum;
      }
    }
}
