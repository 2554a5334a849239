// Counts the floating-point operations of an exported controller: its float64 is a class that counts.
#include <cmath>
#include <math.h>
#include <stdint.h>
#include <stdio.h>

static int64_t operations;

struct Counted {
    double value;
    constexpr Counted(double v = 0.0) : value(v) {}
    Counted &operator+=(Counted b) { return *this = Counted(counted(value + b.value)); }
    Counted &operator-=(Counted b) { return *this = Counted(counted(value - b.value)); }
    Counted &operator*=(Counted b) { return *this = Counted(counted(value * b.value)); }
    Counted operator-() const { return Counted(-value); }
    static double counted(double result) { operations++; return result; }
};

[[maybe_unused]] static Counted operator+(Counted a, Counted b) { return Counted(Counted::counted(a.value + b.value)); }
[[maybe_unused]] static Counted operator-(Counted a, Counted b) { return Counted(Counted::counted(a.value - b.value)); }
static Counted operator*(Counted a, Counted b) { return Counted(Counted::counted(a.value * b.value)); }
[[maybe_unused]] static Counted operator/(Counted a, Counted b) { return Counted(Counted::counted(a.value / b.value)); }
[[maybe_unused]] static bool operator<(Counted a, Counted b) { return a.value < b.value; }
[[maybe_unused]] static bool operator>(Counted a, Counted b) { return a.value > b.value; }
[[maybe_unused]] static bool operator>=(Counted a, Counted b) { return a.value >= b.value; }
[[maybe_unused]] static bool operator!=(Counted a, Counted b) { return a.value != b.value; }
static bool isfinite(Counted a) { return std::isfinite(a.value); }
[[maybe_unused]] static Counted sqrt(Counted a) { return Counted(Counted::counted(std::sqrt(a.value))); }
[[maybe_unused]] static Counted fabs(Counted a) { return Counted(std::fabs(a.value)); }
[[maybe_unused]] static Counted copysign(Counted a, Counted b) { return Counted(std::copysign(a.value, b.value)); }
[[maybe_unused]] static Counted fma(Counted a, Counted b, Counted c)
{
    operations++;
    return Counted(Counted::counted(std::fma(a.value, b.value, c.value)));
}

#define double Counted
#include "anc.c"
#undef double

// Input: x(n) and e(n) of each sample. Output: the operations of each.
int main()
{
    static anc_state state;
    double x, e;
    anc_init(&state);
    while (fread(&x, sizeof x, 1, stdin) == 1 && fread(&e, sizeof e, 1, stdin) == 1) {
        operations = 0;
        anc_control_signal(&state, x);
        anc_update(&state, e);
        const double counted = (double)operations;
        fwrite(&counted, sizeof counted, 1, stdout);
    }
    return 0;
}
