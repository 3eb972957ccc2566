// A control loop in C++ that reads touch, as client_reader.py does in Python: client_reader ENDPOINT FRAMES
#include <handtouch/hand.hpp>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <thread>
#include <vector>

using handtouch::Hand;

static double quantile(std::vector<double>& values, double share) {
    std::sort(values.begin(), values.end());
    return values.empty() ? -1.0 : values[static_cast<std::size_t>(share * (values.size() - 1))];
}

int main(int argc, char** argv) {
    if (argc != 3) return 2;
    const std::size_t frames = std::strtoul(argv[2], nullptr, 10);
    Hand hand("right", argv[1]);
    const handtouch::Frame* frame = hand.wait(std::chrono::seconds(10));
    if (frame == nullptr) return 1;

    std::vector<double> latency_us, none_us, one_us;
    while (latency_us.size() < frames) {  // a loop that each frame wakes
        frame = hand.wait(std::chrono::seconds(10));
        if (frame == nullptr) return 1;
        latency_us.push_back(1e-3 * static_cast<double>(Hand::now_ns() - frame->t_ns));
    }
    std::int64_t seen = frame->seq;
    while (one_us.size() < frames) {  // a loop that never waits
        const std::int64_t begin_ns = Hand::now_ns();
        frame = hand.latest();
        const bool touched = frame != nullptr && frame->touched(3) && frame->force_n[3] > 0.0;
        const double took_us = 1e-3 * static_cast<double>(Hand::now_ns() - begin_ns);
        if (frame == nullptr || touched) return 1;
        (frame->seq == seen ? none_us : one_us).push_back(took_us);
        if (none_us.size() > 1000000) none_us.resize(1000);
        seen = frame->seq;
    }
    std::this_thread::sleep_for(std::chrono::seconds(1));
    frame = hand.latest();
    if (frame == nullptr) return 1;
    const double age_ms = 1e-6 * static_cast<double>(Hand::now_ns() - frame->t_ns);
    std::printf("{\"latency_us\": %f, \"latency_p99_us\": %f, \"none_us\": %f, \"one_us\": %f, \"age_ms\": %f}\n",
                quantile(latency_us, 0.5), quantile(latency_us, 0.99), quantile(none_us, 0.5),
                quantile(one_us, 0.5), age_ms);
}
