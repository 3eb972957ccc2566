// Print what the C++ client reads, as lines of JSON; as tests/javascript/dump.mjs does.
//
//     dump all ENDPOINT COUNT     every contact and hand message, until so many have come
//     dump newest ENDPOINT COUNT  newest frames of the hand `right`, and the contacts with each
//     dump ages ENDPOINT COUNT    after a line of input, the ages of so many newest frames, or "none"
//     dump unknown ENDPOINT       the error of a hand that the daemon doesn't have
//     dump touched                for each line of hexadecimal digits whether the first pad is touched
//     dump decode                 for each line of hexadecimal digits "ok" or "refused"
#include <handtouch/hand.hpp>

#include <cinttypes>
#include <cstdio>
#include <iostream>

namespace {

void print(const std::string& value) { std::printf("\"%s\"", value.c_str()); }
void print(bool value) { std::fputs(value ? "true" : "false", stdout); }
void print(std::int64_t value) { std::printf("%" PRId64, value); }
void print(std::uint32_t value) { std::printf("%" PRIu32, value); }
void print(std::uint8_t value) { std::printf("%u", value); }
void print(double value) { std::isnan(value) ? std::printf("null") : std::printf("%.17g", value); }
void print(float value) { print(static_cast<double>(value)); }

template <class Items>
void print_list(const Items& items) {
    const char* separator = "";
    std::putchar('[');
    for (const auto& item : items) {
        std::fputs(separator, stdout);
        print(item);
        separator = ",";
    }
    std::putchar(']');
}

template <std::size_t N>
void print(const handtouch::Vector<N>& value) { print_list(value); }
void print(const std::vector<std::string>& value) { print_list(value); }
void print(const std::vector<handtouch::ContactPart>& parts);
template <class T, std::size_t N>
void print(const handtouch::Column<T, N>& value) { print_list(value.values()); }

template <class T>
void print(const std::optional<T>& value) {
    if (value) print(*value);
    else std::fputs("null", stdout);
}

template <class T>
void field(const std::string& name, const T& value, const char* separator = ",") {
    std::printf("%s\"%s\":", separator, name.c_str());
    print(value);
}

struct FieldPrinter {
    template <class T>
    void operator()(const char* name, const T& value, bool) const { field(name, value); }
    template <class T, std::size_t N>
    void operator()(const char* name, const handtouch::Column<T, N>& column, bool) const {
        if (!column.empty()) field(name, column);
    }
};

struct PartPrinter {
    const char* separator = "";
    template <class T>
    void operator()(const char* name, const T& value, bool) {
        field(name, value, separator);
        separator = ",";
    }
    template <class T>
    void operator()(const char* name, const std::optional<T>& value, bool optional) {
        if (!value && optional) return;
        field(name, value, separator);
        separator = ",";
    }
};

void print(const std::vector<handtouch::ContactPart>& parts) {
    const char* separator = "";
    std::putchar('[');
    for (const handtouch::ContactPart& part : parts) {
        std::printf("%s{", separator);
        PartPrinter print_field;
        handtouch::each_field_of_contact_part(part, print_field);
        std::putchar('}');
        separator = ",";
    }
    std::putchar(']');
}

void print_contact(const handtouch::Contact& c) {
    std::printf("{\"kind\":\"contact\"");
    handtouch::each_field_of_contact(c, FieldPrinter{});
    std::puts("}");
}

void print_frame(const handtouch::Frame& f, const std::map<std::string, handtouch::Contact>* contacts) {
    std::printf("{\"kind\":\"hand\"");
    field("session", f.session); field("seq", f.seq); field("t_ns", f.t_ns); field("tick", f.tick);
    field("retained", f.retained); field("hand", f.hand); field("links", f.links);
    handtouch::each_field_of_frame_columns(f, FieldPrinter{});
    if (contacts != nullptr) {
        std::printf(",\"contacts\":{");
        const char* separator = "";
        for (const auto& [link, contact] : *contacts) {
            std::printf("%s\"%s\":%" PRId64, separator, link.c_str(), contact.id);
            separator = ",";
        }
        std::putchar('}');
    }
    std::puts("}");
}

std::string receive(void* socket) {
    zmq_msg_t message;
    zmq_msg_init(&message);
    if (zmq_msg_recv(&message, socket, 0) < 0) throw std::runtime_error(zmq_strerror(zmq_errno()));
    std::string bytes(static_cast<const char*>(zmq_msg_data(&message)), zmq_msg_size(&message));
    zmq_msg_close(&message);
    return bytes;
}

void dump_all(const char* endpoint, int count) {
    void* context = zmq_ctx_new();
    void* socket = zmq_socket(context, ZMQ_SUB);
    const int queue = 100000;
    zmq_setsockopt(socket, ZMQ_RCVHWM, &queue, sizeof queue);
    zmq_setsockopt(socket, ZMQ_SUBSCRIBE, "", 0);
    zmq_connect(socket, endpoint);
    for (int i = 0; i < count; ++i) {
        const std::string topic = receive(socket), payload = receive(socket);
        if (topic.compare(0, 8, "contact/") == 0) print_contact(handtouch::decode_contact(payload));
        else print_frame(handtouch::decode_frame(payload), nullptr);
    }
    zmq_close(socket);
    zmq_ctx_term(context);
}

void dump_newest(const char* endpoint, int count) {
    handtouch::Hand hand("right", endpoint, nullptr, std::chrono::hours(1000000));  // whatever its age
    hand.on_contact = print_contact;
    for (int i = 0; i < count; ++i) {
        const handtouch::Frame* frame = hand.wait(std::chrono::seconds(60));
        if (frame == nullptr) throw std::runtime_error("no frame");
        const auto contacts = hand.contacts();
        print_frame(*frame, &contacts);
        std::fflush(stdout);
    }
}

void dump_ages(const char* endpoint, int count) {
    handtouch::Hand hand("right", endpoint);
    while (hand.wait(std::chrono::milliseconds(10)) == nullptr) continue;
    std::puts("{\"kind\":\"ready\"}");
    std::fflush(stdout);
    std::string line;
    std::getline(std::cin, line);
    for (int i = 0; i < count; ++i) {
        const handtouch::Frame* frame = hand.latest();
        if (frame == nullptr) {
            std::puts("{\"kind\":\"none\"}");
        } else {
            std::printf("{\"kind\":\"hand\"");
            field("age_s", 1e-9 * static_cast<double>(handtouch::Hand::now_ns() - frame->t_ns));
            std::puts("}");
        }
        std::fflush(stdout);
        zmq_poll(nullptr, 0, 5);
    }
}

void dump_unknown(const char* endpoint) {
    handtouch::Hand hand("rigth", endpoint);
    try {
        hand.wait(std::chrono::seconds(60));
    } catch (const handtouch::UnknownNameError& error) {
        std::puts(error.what());
    }
}

void dump_touched() {
    for (std::string line; std::getline(std::cin, line);) {
        std::string bytes;
        for (std::size_t i = 0; i + 1 < line.size(); i += 2)
            bytes.push_back(static_cast<char>(std::stoi(line.substr(i, 2), nullptr, 16)));
        try {
            std::puts(handtouch::decode_frame(bytes).touched(0) ? "touched" : "clear");
        } catch (const handtouch::NotSampledError& error) {
            std::puts(error.what());
        }
    }
}

void dump_decoded() {
    for (std::string line; std::getline(std::cin, line);) {
        std::string bytes;
        for (std::size_t i = 0; i + 1 < line.size(); i += 2)
            bytes.push_back(static_cast<char>(std::stoi(line.substr(i, 2), nullptr, 16)));
        try {
            handtouch::decode_frame(bytes);
            std::puts("ok");
        } catch (const handtouch::WireError&) {
            std::puts("refused");
        }
    }
}

}  // namespace

int main(int argc, char** argv) {
    const std::string mode = argc > 1 ? argv[1] : "";
    if (mode == "all" && argc == 4) dump_all(argv[2], std::atoi(argv[3]));
    else if (mode == "newest" && argc == 4) dump_newest(argv[2], std::atoi(argv[3]));
    else if (mode == "ages" && argc == 4) dump_ages(argv[2], std::atoi(argv[3]));
    else if (mode == "unknown" && argc == 3) dump_unknown(argv[2]);
    else if (mode == "touched") dump_touched();
    else if (mode == "decode") dump_decoded();
    else return 2;
}
