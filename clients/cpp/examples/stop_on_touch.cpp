// Print when a pad is touched, as a controller would stop its finger: stop_on_touch HAND LINK [ENDPOINT]
#include <handtouch/hand.hpp>

#include <cstdio>
#include <exception>

int main(int argc, char** argv) try {
    if (argc < 3) {
        std::fprintf(stderr, "usage: %s HAND LINK [ENDPOINT]\n", argv[0]);
        return 2;
    }
    handtouch::Hand hand(argv[1], argc > 3 ? argv[3] : "tcp://127.0.0.1:5580");
    while (const handtouch::Frame* frame = hand.wait(std::chrono::seconds(5))) {
        const std::size_t row = frame->row(argv[2]);
        if (!frame->sampled(row)) continue;  // no valid sample: here a robot waits
        if (frame->touched(row)) {
            std::printf("%s touched: %.2f N, sample %.1f ms old\n", argv[2], frame->force_n[row],
                        1e3 * frame->age_s(row, handtouch::Hand::now_ns()));
            return 0;
        }
    }
    std::fprintf(stderr, "no frames of hand %s for 5 s: check its name, and that handtouch runs\n", argv[1]);
    return 1;
} catch (const std::exception& error) {  // an unknown link
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
}
